"""The size of a pool follows the failures: it grows at once, shrinks late and one by one, and doesn't go to and fro."""

from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.advice.adaptive_size import COUNTED, REST, CurrentSize, SizingTarget, decide_size
from understudy.advice.failure_rate import Rate, estimate_rate
from understudy.advice.shortage_risk import loss_risk

AIM = SizingTarget(risk=0.01, measure="loss", refill=30.0, least=1, most=20)
OFTEN, SELDOM = Rate(2.0, 1.5, 2.6), Rate(0.01, 0.005, 0.02)


def test_the_first_size_is_enough_for_the_risk_at_the_expected_rate():
    found = decide_size(AIM, 100, OFTEN, None, 0.0)
    offered = 100 * 2.0 / 3600 * 30
    assert loss_risk(offered, found.size) <= 0.01 < loss_risk(offered, found.size - 1)
    assert (found.size, found.since) == (found.needed, 0.0)


def test_a_pool_grows_at_once_to_the_required_size():
    before = CurrentSize(2, since=99.0)
    found = decide_size(AIM, 100, OFTEN, before, 100.0)
    assert found.size == found.needed > 3
    assert found.since == 100.0


def test_a_pool_shrinks_one_by_one_and_not_soon_after_a_change():
    held, sizes = CurrentSize(5, since=0.0), []
    for minute in range(60):
        found = decide_size(AIM, 10, SELDOM, held, minute * 60.0)
        held = CurrentSize(found.size, found.since)
        sizes.append(found.size)
    assert sizes == [5] * 10 + [4] * 10 + [3] * 10 + [2] * 10 + [1] * 20


def test_a_pool_shrinks_only_if_the_smaller_size_is_certainly_enough():
    unsure = replace(SELDOM, high=2.0)
    found = decide_size(AIM, 100, unsure, CurrentSize(5, since=0.0), 10 * REST)
    assert (found.size, found.shrinks) == (5, False)
    assert found.needed < 5 <= found.safe


def test_limits_apply_at_once_and_take_precedence_over_the_risk():
    assert decide_size(replace(AIM, most=3), 1000, OFTEN, CurrentSize(5, since=0.0), 1.0).size == 3
    assert decide_size(replace(AIM, least=8), 1, SELDOM, CurrentSize(5, since=0.0), 1.0).size == 8
    assert decide_size(AIM, 1_000_000, OFTEN, None, 0.0).needed == COUNTED


def test_a_pool_without_robots_needs_no_pods():
    assert decide_size(replace(AIM, least=0), 0, OFTEN, None, 0.0).size == 0


def test_reserved_pods_are_added_to_the_size():
    plain, more = (decide_size(aim, 100, OFTEN, None, 0.0).size for aim in (AIM, replace(AIM, kept_back=2)))
    assert more == plain + 2


@pytest.mark.parametrize("seed", range(5))
def test_the_size_does_not_oscillate_for_a_steady_fleet(seed):
    """A fleet of 50 fails about once an hour; what comes in by chance makes the size no swing."""
    draw, held, total, sizes = Random(seed), None, [], []
    for minute in range(48 * 60):
        now = minute * 60.0
        total += [now] * (draw.random() < 1 / 60)
        counted = [moment for moment in total if now - moment < 86400]
        rate = estimate_rate(1.0, len(counted), 50 * min(24.0, now / 3600))
        found = decide_size(replace(AIM, refill=300.0), 50, rate, held, now)
        held = CurrentSize(found.size, found.since)
        sizes.append(found.size)
    turns = [later - one for one, later in pairwise(sizes) if later != one]
    assert sum(one * other < 0 for one, other in pairwise(turns)) <= 2
    assert sizes[-1] < sizes[0]


@settings(deadline=None)
@given(st.integers(0, 500), st.floats(0.001, 10), st.integers(0, 30), st.floats(0, 1e5))
def test_the_size_stays_within_its_limits_and_covers_the_need(robots, rate, size, age):
    found = decide_size(AIM, robots, estimate_rate(rate, 3, 100.0), CurrentSize(size, since=0.0), age)
    assert AIM.least <= found.size <= AIM.most
    assert found.size >= min(found.needed, AIM.most)
    assert found.needed <= found.safe
