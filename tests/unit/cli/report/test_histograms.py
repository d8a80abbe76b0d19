"""What is made of times of which only their bounds are known."""

from __future__ import annotations

from math import inf

import pytest

from understudy.cli.report.prometheus.histograms import Bucket, Histogram


def histogram(*below: float) -> Histogram:
    """Of times up to 0.1 s, 1 s, 10 s and beyond, one second long in the mean."""
    found = Histogram.of(dict(zip((0.1, 1.0, 10.0, inf), below, strict=True)), below[-1])
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("fraction", "seconds", "beyond"),
    [(0.0, 0.1, False), (0.25, 0.55, False), (0.5, 1.0, False), (0.75, 5.5, False), (1.0, 10.0, False)],
)
def test_a_quantile_lies_linearly_between_the_bounds_about_it(fraction: float, seconds: float, beyond: bool) -> None:
    found = histogram(0, 2, 4, 4)
    assert found.quantile(fraction) == pytest.approx(seconds)
    assert found.is_beyond(fraction) is beyond


def test_a_quantile_beyond_the_last_bound_is_at_least_that() -> None:
    found = histogram(0, 0, 2, 4)
    assert (found.quantile(0.95), found.is_beyond(0.95)) == (10.0, True)
    assert found.is_beyond(0.5) is False


def test_the_mean_is_that_of_the_times_themselves() -> None:
    assert (histogram(0, 2, 4, 4).mean, histogram(0, 2, 4, 4).count) == (1.0, 4)


def test_buckets_lie_from_bound_to_bound() -> None:
    assert list(histogram(1, 1, 4, 5).buckets()) == [
        Bucket(0.0, 0.1, 1), Bucket(0.1, 1.0, 0), Bucket(1.0, 10.0, 3), Bucket(10.0, inf, 1),
    ]  # fmt: skip


def test_counts_never_fall() -> None:
    assert list(histogram(2, 1, 3, 2).counts) == [2, 2, 3, 3]


@pytest.mark.parametrize("below", [{}, {0.1: 0.0, inf: 0.0}, {0.1: 0.0, inf: 0.3}, {0.1: 1.0}])
def test_of_nothing_there_is_no_histogram(below: dict[float, float]) -> None:
    assert Histogram.of(below, 0.0) is None
