"""What a monitor says of a workload that is healthy and not well, and that it keeps its health apart from it."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.unit.monitor.degraded_workload import (
    ACTIVE,
    FAILED,
    HEALTHY,
    OTHER,
    SLOW,
    UNKNOWN,
    WELL,
    World,
    policy,
)
from tests.unit.monitor.monitors import GivenMonitor
from understudy.failover.decide import Recover
from understudy.failover.interfaces import GateState
from understudy.monitor.judge.degradation_level import AGAIN, CHECK_PERIOD
from understudy.monitor.notices import BecameDegraded
from understudy.trees.core.health_tree import Verdict


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_a_workload_is_degraded_after_the_debounce_and_well_after_the_clear_time(world: World) -> None:
    assert not world.look(1)
    assert world.condition == ("False", "Well")
    world.observer.well = SLOW
    assert not world.look(1.5)
    assert world.look(1)
    assert world.condition == ("True", "NotWell")
    assert sum(isinstance(notice, BecameDegraded) for notice in world.notices.log) == 1
    message = world.notices.conditions["Degraded"][2]
    assert_golden("monitor", message, "/scan", "8.6 Hz", "9 Hz", "2 s", "spec.degraded")
    world.observer.well = HEALTHY
    assert world.look(4.5)
    assert not world.look(1)
    assert world.condition == ("False", "Well")
    assert [(kind, reason) for kind, reason, _ in world.notices.events] == [
        ("Warning", "Degraded"),
        ("Normal", "WellAgain"),
    ]


def test_without_spec_degraded_nothing_is_evaluated(world: World) -> None:
    world.observer.well = SLOW
    assert not world.look(10, policy=policy())
    assert world.observer.times_asked == 0
    assert world.notices.conditions == {}


def test_degradation_is_judged_less_often_than_health(world: World) -> None:
    world.look(10)
    assert world.observer.times_asked <= 10 / CHECK_PERIOD + 1


def test_changing_figures_are_written_rarely(world: World) -> None:
    for hundredth in range(600):
        world.observer.well = Verdict("Failed", f"/scan at 8.{hundredth} Hz", "sensors/scan", None)
        world.look(0.1)
    assert world.notices.changes <= 2 + 60 / AGAIN
    assert len(world.notices.events) == 1


def test_another_failing_leaf_is_reported_at_once(world: World) -> None:
    world.observer.well = SLOW
    world.look(3)
    world.observer.well = Verdict("Failed", "/cmd_vel at 15 Hz", "commands", None)
    world.look(0.3)
    assert "in leaf commands" in world.notices.conditions["Degraded"][2]


def test_an_instance_whose_health_fails_stays_degraded_and_is_not_evaluated(world: World) -> None:
    world.observer.well = SLOW
    world.look(3)
    world.observer.well = HEALTHY
    world.look(4)
    asked = world.observer.times_asked
    assert world.look(3, health=FAILED), "that it fails doesn't make it well"
    assert world.observer.times_asked == asked
    assert world.look(4), "and the clear time begins anew"
    assert not world.look(2)


def test_another_instance_starts_with_an_unknown_level(world: World) -> None:
    world.observer.well = SLOW
    world.look(3)
    world.observer.well = UNKNOWN
    assert not world.look(0.5, active=OTHER)
    assert world.condition == ("Unknown", "Starting")
    world.observer.well = HEALTHY
    assert not world.look(0.5, active=OTHER)
    assert world.condition == ("False", "Well")


def test_a_new_monitor_continues_with_the_level_of_its_predecessor(world: World) -> None:
    world.adopt("w-1")
    world.observer.well = UNKNOWN
    assert world.look(1)
    world.observer.well = HEALTHY
    assert world.look(4)
    assert not world.look(2)
    assert [reason for _, reason, _ in world.notices.events] == ["WellAgain"], "it is told once that it was degraded"


def test_the_level_of_another_instance_does_not_count(world: World) -> None:
    world.adopt("w-0")
    world.observer.well = UNKNOWN
    assert not world.look(1)
    assert world.condition == ("Unknown", "Starting")


def test_the_condition_is_removed_with_spec_degraded(world: World) -> None:
    world.observer.well = SLOW
    world.look(3)
    assert not world.look(1, policy=policy())
    assert "Degraded" not in world.notices.conditions


@pytest.mark.parametrize(
    ("health", "well", "level"),
    [(HEALTHY, SLOW, "Degraded"), (HEALTHY, HEALTHY, "Healthy"), (FAILED, SLOW, "Failed"), (UNKNOWN, SLOW, "Starting")],
)
async def test_degradation_neither_causes_nor_delays_a_failover(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, health: Verdict, well: Verdict, level: str
) -> None:
    at_once = policy({"monitoring": {**WELL, "debounce": "0s"}})
    monitor = GivenMonitor(tmp_path)
    monitor.objects.put_workload()
    monitor.objects.put_policy(at_once)
    monitor.objects.put_settings()
    monitor.objects.put_pods(ACTIVE)
    monitor.objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    monitor.observer.health, monitor.observer.well = health, well
    judged: list[str] = []
    monkeypatch.setattr(monitor.state_manager, "judge", lambda state, now: judged.append(state))
    found = await monitor.loop.evaluate(at_once, time.time())
    assert isinstance(found.decision, Recover) == (health is FAILED)
    assert monitor.notices.status.health == level
    assert judged == [health.state], "state is kept of what is healthy, well or not"
