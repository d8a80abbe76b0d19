"""The paper's argument, with its figures."""

from itertools import combinations_with_replacement

import pytest

from understudy.advice.paper_model import estimate

RATE = 1000 / 3600


def test_the_figures_of_the_paper_are_reproduced():
    """Section IV.D: 1000 failures an hour are 8.3 in 30 s; with 4 fallbacks about 5 remain, in 6 s of 30 in 1.2 %."""
    argument = estimate(RATE, 6.0, 4)
    assert argument.expected == pytest.approx(8.33, abs=0.01)
    assert argument.remaining == 5
    assert (argument.together, argument.ways) == (3276, 278256)
    assert round(argument.chance * 100, 1) == 1.2


@pytest.mark.parametrize(
    ("fallbacks", "window", "interval"), [(4, 6, 12), (5, 3, 12), (6, 2, 10), (2, 20, 12), (7, 1, 9)]
)
def test_the_counted_ways_equal_an_enumeration(fallbacks, window, interval):
    argument = estimate(RATE * 3, window, fallbacks, interval)
    ways = list(combinations_with_replacement(range(interval), argument.remaining))
    within = [way for way in ways if not way or way[-1] - way[0] < window]
    assert (argument.together, argument.ways) == (len(within), len(ways))


def test_no_failures_remain_with_enough_fallbacks():
    argument = estimate(RATE, 6.0, 9)
    assert (argument.remaining, argument.chance) == (0, 1.0)
