"""How often robots fail: what was assumed counts until more was seen."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.advice.failure_rate import estimate_rate


def test_the_assumed_rate_counts_without_observations():
    rate = estimate_rate(2.0, 0, 0.0)
    assert rate.expected == pytest.approx(2.0)
    assert (rate.low, rate.high) == (pytest.approx(2.0 * 0.0513, rel=1e-3), pytest.approx(2.0 * 2.9957, rel=1e-3))


@pytest.mark.parametrize(
    ("failures", "low", "high"),
    # Halves of the quantiles of chi-square with 2 (failures + 1) degrees of freedom, by the tables.
    [
        (1, 0.7107 / 2, 9.4877 / 2),
        (4, 3.9403 / 2, 18.307 / 2),
        (9, 10.851 / 2, 31.410 / 2),
        (49, 77.929 / 2, 124.342 / 2),
    ],
)
def test_the_limits_equal_tabulated_quantiles(failures, low, high):
    rate = estimate_rate(1.0, failures, 99.0)
    assert (rate.low, rate.high) == (pytest.approx(low / 100, rel=1e-3), pytest.approx(high / 100, rel=1e-3))


def test_the_rate_falls_while_a_fleet_does_not_fail():
    rates = [estimate_rate(1.0, 0, hours).high for hours in (0, 10, 100, 1000)]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.01


def test_observations_soon_outweigh_the_assumed_rate():
    low, high = estimate_rate(0.01, 100, 1000.0).expected, estimate_rate(10.0, 100, 1000.0).expected
    assert low == pytest.approx(high, rel=0.11)


@settings(deadline=None)
@given(st.floats(0.0001, 3600), st.integers(0, 3000), st.floats(0, 1e6))
def test_the_expected_rate_is_between_its_limits(assumed, failures, hours):
    rate = estimate_rate(assumed, failures, hours)
    assert 0 < rate.low < rate.expected < rate.high
