"""The table of precedence, row by row, and the order of its rows."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from understudy.failover import decide as table
from understudy.failover.decide import (
    LIMITS,
    TRIGGERS,
    Activate,
    Defer,
    Facts,
    Hold,
    Limit,
    LimitRow,
    Occurrence,
    Recover,
    Requirement,
    SwitchOver,
    Trigger,
    TriggerRow,
    Wait,
    decide,
    in_force,
)
from understudy.failover.limits.state import ROBOT_AWAY, ActiveLimit, LimitsInForce

NOW = 1_000_000.0
LATER = NOW + 20


def facts(trigger: Trigger, *rows: LimitRow) -> Facts:
    """Facts in which a trigger is present and the limits of these rows are in force."""
    found, occurrence = Facts(NOW), Occurrence(trigger, "no /cmd_vel for 500 ms")
    for row in rows:
        match row.limit:
            case Limit.STALE_SAMPLES:
                found = replace(found, trusted_from=LATER)
            case Limit.DEBOUNCE:
                occurrence = replace(occurrence, counts_from=LATER)
            case Limit.UPSTREAM_FAILURE:
                occurrence = replace(occurrence, upstream=ActiveLimit("lidar fails", LATER))
            case Limit.PAUSE:
                found = replace(found, limits=replace(found.limits, pause=ActiveLimit("paused by ann", LATER)))
            case Limit.ROBOT_AWAY:
                found = replace(found, limits=replace(found.limits, away=ROBOT_AWAY))
            case Limit.REQUIREMENT:
                occurrence = replace(occurrence, unmet=Requirement(row.reason, "w-1 is new"))  # type: ignore[arg-type]
            case Limit.WAIT_AFTER_RECOVERY:
                found = replace(found, limits=replace(found.limits, waiting=ActiveLimit(until=LATER)))
            case Limit.STORM:
                found = replace(found, limits=replace(found.limits, storm=ActiveLimit("4 of 6 fail", LATER)))
            case Limit.CRASH_LOOP:
                occurrence = replace(occurrence, first_strategy=None, retry_after=20.0)
            case Limit.BUDGET:
                found = replace(found, limits=replace(found.limits, budget=ActiveLimit("5 were made", LATER)))
    return replace(found, occurrences=(occurrence,))


CASES = [(row, trigger) for row in LIMITS for trigger in sorted(row.triggers)]


@pytest.mark.parametrize(("row", "trigger"), CASES, ids=lambda one: getattr(one, "reason", str(one)))
def test_a_limit_alone_leads_to_the_decision_of_its_row(row: LimitRow, trigger: Trigger) -> None:
    decision = decide(facts(trigger, row))
    assert isinstance(decision, row.decision)
    assert (decision.reason, decision.trigger) == (row.reason, trigger)
    assert decision.deadline == (None if row.limit in (Limit.REQUIREMENT, Limit.ROBOT_AWAY) else LATER)
    assert "{" not in decision.message


@pytest.mark.parametrize("trigger", Trigger)
def test_the_earlier_of_two_limits_in_the_table_decides(trigger: Trigger) -> None:
    rows = [row for row in LIMITS if trigger in row.triggers]
    for first, second in pairwise(rows):
        if first.limit != second.limit:  # a trigger has one requirement at a time
            assert decide(facts(trigger, second, first)).reason == first.reason


@pytest.mark.parametrize("trigger", Trigger)
def test_a_limit_that_does_not_apply_to_a_trigger_does_not_prevent_it(trigger: Trigger) -> None:
    others = [row for row in LIMITS if row.limit not in {one.limit for one in LIMITS if trigger in one.triggers}]
    (row,) = (row for row in TRIGGERS if row.trigger == trigger)
    assert isinstance(decide(facts(trigger, *others)), row.decision)


@pytest.mark.parametrize("row", TRIGGERS, ids=lambda row: row.trigger)
def test_a_trigger_without_limits_leads_to_the_decision_of_its_row(row: TriggerRow) -> None:
    decision = decide(facts(row.trigger))
    assert isinstance(decision, row.decision)
    assert (decision.reason, decision.message) == (row.trigger.value, "no /cmd_vel for 500 ms")


def test_every_trigger_has_one_row_and_the_first_present_one_decides() -> None:
    assert {row.trigger for row in TRIGGERS} == set(Trigger)
    assert len(TRIGGERS) == len(Trigger)
    for index, row in enumerate(TRIGGERS):
        present = tuple(Occurrence(other.trigger) for other in reversed(TRIGGERS[index:]))
        assert decide(Facts(NOW, present)).trigger == row.trigger


def test_nothing_is_due_without_a_trigger() -> None:
    assert decide(Facts(NOW)) == Wait("NothingDue")


def test_a_deferred_trigger_that_yields_lets_the_next_one_be_considered() -> None:
    waiting = LimitsInForce(waiting=ActiveLimit(until=LATER))
    reaction, takeover = Occurrence(Trigger.DEPENDENCY_RECOVERED), Occurrence(Trigger.UNSETTLED_SWITCHOVER)
    assert isinstance(decide(Facts(NOW, (reaction, takeover), waiting)), SwitchOver)
    failure = Occurrence(Trigger.HEALTH_FAILED)
    both = list(table.considered(Facts(NOW, (reaction, failure), waiting)))
    assert [(type(one), one.trigger) for one in both] == [
        (Defer, Trigger.DEPENDENCY_RECOVERED),
        (Defer, Trigger.HEALTH_FAILED),
    ]


def test_a_deferred_trigger_that_does_not_yield_is_the_last_one_considered() -> None:
    failure = Occurrence(Trigger.HEALTH_FAILED, counts_from=LATER)
    switchover = Occurrence(Trigger.SWITCHOVER_REQUESTED)
    assert decide(Facts(NOW, (failure, switchover))) == Wait(
        "Debounce", "monitoring.debounce of the policy has not passed", LATER, Trigger.HEALTH_FAILED
    )


def test_a_storm_does_not_defer_a_failure_if_a_standby_is_ready() -> None:
    storm = LimitsInForce(storm=ActiveLimit("4 of 6 fail", LATER))
    found = Facts(NOW, (Occurrence(Trigger.HEALTH_FAILED),), storm)
    assert isinstance(decide(found), Defer)
    assert isinstance(decide(replace(found, standby_ready=True)), Recover)


def test_a_robot_that_cannot_be_reached_defers_what_its_silence_causes_and_not_the_loss_of_a_pod() -> None:
    away = LimitsInForce(away=ROBOT_AWAY)
    assert decide(Facts(NOW, (Occurrence(Trigger.HEALTH_FAILED),), away)) == Defer(
        "RobotAway",
        "no mux reports at the robot, so no other instance would reach it",
        trigger=Trigger.HEALTH_FAILED,
    )
    assert isinstance(decide(Facts(NOW, (Occurrence(Trigger.POD_LOST),), away)), Recover)


def test_a_takeover_by_the_reflex_is_never_held() -> None:
    everything = LimitsInForce(ActiveLimit(), ActiveLimit(), ActiveLimit(), ActiveLimit(), ActiveLimit())
    assert isinstance(decide(Facts(NOW, (Occurrence(Trigger.REFLEX_TAKEOVER),), everything)), Recover)


def test_the_decision_starts_with_the_strategy_of_the_trigger() -> None:
    decision = decide(Facts(NOW, (Occurrence(Trigger.POD_LOST, first_strategy=1),)))
    assert isinstance(decision, Recover)
    assert decision.first_strategy == 1


def test_all_limits_in_force_are_listed_in_order_with_their_decisions() -> None:
    every = LimitsInForce(ActiveLimit("paused"), ActiveLimit(until=LATER), ActiveLimit("storm"), ActiveLimit("spent"))
    found = list(in_force(Facts(NOW, (), every), Occurrence(Trigger.HEALTH_FAILED)))
    assert [one.row.limit for one in found] == [Limit.PAUSE, Limit.WAIT_AFTER_RECOVERY, Limit.STORM, Limit.BUDGET]
    assert [type(one.decision) for one in found] == [Defer, Defer, Defer, Hold]


def test_the_first_pod_is_activated_once_it_is_ready_and_the_workload_is_not_paused() -> None:
    assert isinstance(decide(Facts(NOW, (Occurrence(Trigger.INITIAL_ACTIVATION),))), Activate)
    none = Occurrence(Trigger.INITIAL_ACTIVATION, unmet=Requirement("NoPodRunning"))
    assert decide(Facts(NOW, (none,))).reason == "NoPodRunning"
    assert decide(Facts(NOW, (none,), LimitsInForce(pause=ActiveLimit("paused by ann")))).reason == "Paused"
