"""The order that requirements come to: what holds of every one, and of those that the paper tells."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.advice.example_inputs import LEVELS, WAYS, figures, levels, pools, requirements
from understudy.advice.order_explanation import explain, one_line, unmet_requirements
from understudy.advice.strategy_figures import Figure, Figures
from understudy.advice.strategy_order import NEGLIGIBLE, Candidate, Order, effective_resource_usage, order_strategies
from understudy.api.kinds.requirements_spec import Requirements

HOT = Candidate("Executing", "hot", 1)
WARM = Candidate("Initialized", "warm", 1)
SPARE = Candidate("Uninitialized", "spare", 2)
ALL = [HOT, WARM, SPARE]
PUBLISHED = Figures()

tried = settings(max_examples=300, deadline=None)


def order(*candidates: Candidate, known: Figures = PUBLISHED, **levels: str) -> Order:
    return order_strategies(Requirements.model_validate(levels), candidates, known)


def short(*candidates: Candidate, known: Figures = PUBLISHED, **levels: str) -> str:
    return one_line(order(*candidates, known=known, **levels))


# -- what holds of every order ------------------------------------------------------------------------------------------


@tried
@given(requirements, pools, figures)
def test_an_order_is_never_empty_and_always_contains_a_restart(asked, offered, known):
    found = order_strategies(asked, offered, known)
    assert [one.candidate.way for one in found.chosen].count("Restart") == 1


@tried
@given(requirements, pools, figures)
def test_every_pool_is_chosen_once_or_reported_as_left_out(asked, offered, known):
    found = order_strategies(asked, offered, known)
    candidates = [one.candidate for one in (*found.chosen, *found.costly, *found.spared)]
    assert sorted(candidates, key=repr) == sorted([*offered, Candidate("Restart")], key=repr)
    for one in (*found.costly, *found.spared):
        assert one.candidate.pool in explain(found)


@tried
@given(requirements, pools, figures, st.randoms())
def test_equal_requirements_give_equal_orders(asked, offered, known, random):
    shuffled = list(offered)
    random.shuffle(shuffled)
    assert order_strategies(asked, offered, known) == order_strategies(asked, shuffled, known)


@tried
@given(requirements, pools, figures)
def test_more_availability_never_gives_a_slower_first_strategy(asked, offered, known):
    times = [
        order_strategies(asked.model_copy(update={"availability": level}), offered, known).first.seconds.value
        for level in LEVELS
    ]
    assert all(sooner <= later for later, sooner in pairwise(times))


@tried
@given(requirements, pools, figures)
def test_a_more_critical_task_never_gives_a_slower_first_strategy(asked, offered, known):
    asked = asked.model_copy(update={"safety": "Low"})
    times = [
        order_strategies(asked.model_copy(update={"task_criticality": level}), offered, known).first.seconds.value
        for level in LEVELS
    ]
    assert all(sooner <= later for later, sooner in pairwise(times))


@tried
@given(requirements, pools, figures)
def test_no_strategy_exceeds_the_resource_limit(asked, offered, known):
    found = order_strategies(asked, offered, known)
    if effective_resource_usage(asked) == "Low":
        assert all(one.cost <= NEGLIGIBLE for one in found.chosen)
    if effective_resource_usage(asked) == "Medium":
        assert all(one.cost <= NEGLIGIBLE for one in found.chosen[1:])
    if effective_resource_usage(asked) == "High":
        assert len(found.chosen) == len(offered) + 1


@tried
@given(requirements, pools, figures)
def test_with_safety_high_an_executing_standby_is_first_at_any_cost(asked, offered, known):
    found = order_strategies(asked.model_copy(update={"safety": "High"}), offered, known)
    if any(one.way == "Executing" for one in offered):
        assert found.first.candidate.way == "Executing"
    assert not found.costly
    assert not found.spared
    ranks = [WAYS.index(one.candidate.way) for one in found.chosen]
    assert [rank for rank in ranks if rank < 2] == sorted(rank for rank in ranks if rank < 2) == ranks[: _up(offered)]


def _up(offered: list[Candidate]) -> int:
    return sum(one.way in ("Executing", "Initialized") for one in offered)


@tried
@given(requirements, pools, figures, levels)
def test_with_safety_medium_a_running_standby_within_the_limit_is_first(asked, offered, known, usage):
    asked = asked.model_copy(update={"safety": "Medium", "resource_usage": usage})
    found = order_strategies(asked, offered, known)
    left = {one.candidate for one in found.costly}
    if any(one.way in ("Executing", "Initialized") for one in offered if one not in left):
        assert found.first.candidate.way in ("Executing", "Initialized")


@tried
@given(requirements, pools, figures)
def test_exactly_the_unmet_requirements_are_reported(asked, offered, known):
    found = order_strategies(asked, offered, known)
    assert bool(unmet_requirements(found)) == (not found.is_fast_enough or not found.is_safe_enough)


# -- the paper's own cases ----------------------------------------------------------------------------------------------


def test_expensive_goods_justify_a_second_instance():
    """Section IV.D: time-critical tasks with expensive goods employ a fallback in execution mode."""
    found = short(*ALL, task_criticality="High", resource_usage="Low")
    assert found.split(", ") == ["Executing (hot)", "Initialized (warm)", "Uninitialized (spare)", "Restart"]


def test_a_cluster_without_spare_resources_restarts():
    """Section IV.D: with less strict requirements regarding down-time the workload is started from scratch."""
    assert short(HOT, WARM, availability="Low", resource_usage="Low") == "Restart"


def test_a_fleet_with_low_availability_uses_an_uninitialized_fallback():
    assert short(*ALL, availability="Low") == "Uninitialized (spare), Restart"


def test_the_default_is_the_cheapest_strategy_with_a_short_interruption():
    assert short(*ALL).split(", ") == ["Initialized (warm)", "Uninitialized (spare)", "Restart"]


def test_high_availability_uses_one_executing_standby():
    assert short(*ALL, availability="High") == "Executing (hot), Uninitialized (spare), Restart"


def test_high_availability_with_low_resource_usage_is_reported_as_unmet():
    found = order(*ALL, availability="High", resource_usage="Low")
    assert one_line(found) == "Uninitialized (spare), Restart"
    (requirement,) = unmet_requirements(found)
    assert_golden("advice", requirement, "High", "500 ms", "Uninitialized (spare)", "3.96 s", "Executing (hot)")


def test_with_high_resource_usage_all_strategies_are_used():
    found = short(*ALL, availability="Low", resource_usage="High")
    assert found.split(", ") == ["Executing (hot)", "Initialized (warm)", "Uninitialized (spare)", "Restart"]


def test_safety_high_requires_safe_commands():
    found = order_strategies(Requirements(safety="High"), ALL, PUBLISHED, safe_commands=False)
    assert_golden("advice", unmet_requirements(found), "requirements.safety is High", "spec.safety.commands")


@pytest.mark.parametrize(("standbys", "expected"), [(1, "Initialized (warm)"), (2, "Executing (hot)")])
def test_two_standbys_cost_twice_as_much(standbys, expected):
    found = order(Candidate("Initialized", "warm", standbys), HOT)
    assert one_line(found).split(", ")[0] == expected


def test_measured_figures_take_precedence_over_published_ones():
    """An application that starts in a second needs no standby to be back in two."""
    quick = Figures(measured_seconds={"Restart": Figure(1.2, "measured 4 times")})
    found = order(*ALL, known=quick)
    assert one_line(found) == "Restart, Uninitialized (spare)"
    assert_golden("advice", explain(found), "Restart", "1.2 s, measured 4 times")


def test_the_reason_explains_the_chosen_and_the_omitted_strategies():
    assert_golden(
        "advice",
        explain(order(*ALL)),
        "1. Initialized (warm), 2. Uninitialized (spare), 3. Restart. ",
        "within 2 s",
        "830 ms",
        "96%",
        "10%",
    )
