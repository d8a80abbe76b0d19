"""What times say of gaps and rates is what the product's own windows say, only later and of all of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.counting import falls_below, first_from, least_count, most_count, worst_gap
from understudy.trees.core.rate_window import Band, Window

STEADY = [n / 10 for n in range(100)]


def test_the_worst_gap_is_the_longest_that_ends_after_the_given_moment():
    assert worst_gap([0.0, 3.0, 4.0, 6.0], 0.0) == 3.0
    assert worst_gap([0.0, 3.0, 4.0, 6.0], 3.0) == 2.0
    assert worst_gap([0.0, 3.0], 2.0) == 3.0, "it began before"
    assert worst_gap([], 0.0) == worst_gap([1.0], 0.0) == worst_gap([1.0, 2.0], 5.0) == 0.0


def test_counts_are_the_minimum_and_maximum_of_all_windows():
    assert least_count(STEADY, 0.95, 2.0) == 9
    assert most_count(STEADY, 0.95, 2.0) == 10
    missing = [time for time in STEADY if not 5.0 <= time < 5.5]
    assert least_count(missing, 0.95, 2.0) == 4
    assert least_count(missing, 0.95, 7.0) == 9
    assert least_count(STEADY, 20.0, 0.0) is None, "no such window is full"
    assert least_count([], 1.0, 0.0) is None
    assert most_count(STEADY, 1.0, 50.0) is None


@pytest.mark.parametrize(
    ("times", "least", "since", "moment"),
    [
        ([0.0, 1.0, 2.0], 2, 0.0, 4.0),  # the last but one leaves, and nothing follows
        ([0.0, 1.0, 2.0, 6.0, 7.0], 2, 0.0, 4.0),  # what follows is too late
        ([0.0, 1.0, 2.0, 6.0, 7.0], 2, 5.0, 9.0),  # what was before is another matter
        ([0.0, 1.0, 2.0], 5, 0.0, None),
    ],
)
def test_a_rate_falls_when_a_sample_leaves_before_the_next_arrives(times, least, since, moment):
    assert falls_below(times, least, 3.0, since) == moment


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=40),
    st.integers(1, 20),
    st.sampled_from([0.25, 0.5, 1.0]),
)
def test_a_rate_falls_at_the_moment_that_the_tree_determines(steps, hertz, length):
    times = [sum(steps[: n + 1]) / 64 for n in range(len(steps))]  # of which floats are exact
    window = Window(Band.parse(f">= {hertz} Hz"), length)
    moment = falls_below(times, window.least, window.length, times[0])
    known = [time for time in times if moment is None or time <= moment]
    if moment is None:
        assert not any(window.holds(times[: n + 1], time) for n, time in enumerate(times)), "it never held"
        return
    assert window.until(known) == moment
    assert not window.holds(known, moment)
    assert window.holds(known, moment - 1 / 256)


def test_the_first_time_from_a_moment_on_is_found():
    assert first_from([1.0, 2.0], 1.0) == 1.0
    assert first_from([1.0, 2.0], 1.5) == 2.0
    assert first_from([1.0, 2.0], 2.5) is None
