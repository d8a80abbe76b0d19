"""When a degraded instance is handed over: after long enough, while it is idle, and where strategies and limits allow it."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.monitor.degraded_workload import (
    ACTIVE,
    FAILED,
    HAND_OVER,
    HANDED,
    HEALTHY,
    OTHER,
    SLOW,
    UNKNOWN,
    World,
    policy,
)
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.conditions import condition
from understudy.api.kinds.task_spec import TaskStatus
from understudy.failover.availability import Availability
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import Choice, StrategyContext
from understudy.failover.strategies.restart import Restart
from understudy.monitor.decide import strategy_options
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.observe.robot.degraded_tree import BusyReason


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def handed_over(at: float) -> Progress:
    done = Progress.begin("slow", last_healthy=at, detected=at, planned=True)
    done.result = "Recovered"
    return done


GOAL = BusyReason("task", "a goal of /go is active")


class TestDegradedSwitchover:
    def test_a_switchover_is_due_after_enough_degraded_and_idle_time(self, world: World) -> None:
        world.observer.well, world.observer.work = SLOW, GOAL
        world.look(10, policy=HANDED)
        assert world.levels.due is None
        assert_golden("monitor", world.notices.conditions["Degraded"][2], "/go")
        world.observer.work = None
        world.look(2.5, policy=HANDED)
        assert world.levels.due is None
        world.look(2, policy=HANDED)
        assert_golden("monitor", world.levels.due, "/scan", "8.6 Hz", "9 Hz", "2 s", "spec.degraded")

    def test_idle_time_must_be_uninterrupted(self, world: World) -> None:
        world.observer.well, world.observer.work = SLOW, GOAL
        world.look(10, policy=HANDED)
        for _ in range(5):
            world.observer.work = None
            world.look(2.5, policy=HANDED)
            world.observer.work = GOAL
            world.look(0.5, policy=HANDED)
        assert world.levels.due is None

    def test_a_switchover_is_not_due_before_enough_degraded_time(self, world: World) -> None:
        world.observer.well = SLOW
        world.look(4.5, policy=HANDED)
        assert world.levels.due is None
        world.look(2, policy=HANDED)
        assert world.levels.due is not None

    def test_degradation_during_a_task_leads_to_a_switchover_after_the_task(self, world: World) -> None:
        world.observer.well, world.observer.work = SLOW, GOAL
        world.look(10, policy=HANDED)
        world.observer.well, world.observer.work = HEALTHY, None
        world.look(4, policy=HANDED)
        assert world.levels.due is not None
        world.look(8, policy=HANDED)
        assert world.levels.due is None, "it is well by now"

    def test_no_switchover_is_due_while_health_fails_or_degradation_is_unknown(self, world: World) -> None:
        world.observer.well = SLOW
        world.look(10, policy=HANDED)
        world.look(0.5, policy=HANDED, health=FAILED)
        assert world.levels.due is None
        world.observer.well = UNKNOWN
        world.look(5, policy=HANDED)
        assert world.levels.due is None

    def test_goals_of_the_proxy_and_an_unavailable_proxy_count_as_work(self, world: World) -> None:
        world.observer.well = SLOW
        world.notices.set_tasks([TaskStatus(action="/go", active=1)])
        world.look(10, policy=HANDED)
        assert world.levels.due is None
        world.notices.set_tasks([])
        world.notices.condition("TasksProxied", "False", "ProxyNotReady", "It can't be reached")
        world.look(10, policy=HANDED)
        assert world.levels.due is None
        assert "ProxyNotReady" in world.notices.conditions["Degraded"][2]
        world.notices.condition("TasksProxied", "True", "Serving", "")
        world.look(4, policy=HANDED)
        assert world.levels.due is not None

    def test_the_next_switchover_is_due_after_the_pause_between_switchovers(self, world: World) -> None:
        world.observer.well = SLOW
        world.look(10, policy=HANDED)
        assert world.levels.due is not None
        world.levels.handed_over()
        world.look(40, policy=HANDED, active=OTHER)
        assert world.levels.due is None
        assert "less than 1m ago" in world.notices.conditions["Degraded"][2]
        world.look(30, policy=HANDED, active=OTHER)
        assert world.levels.due is not None

    @pytest.mark.parametrize(("ago", "is_due"), [(10.0, False), (100.0, True)])
    def test_a_new_monitor_keeps_the_pause_between_switchovers(self, world: World, ago: float, is_due: bool) -> None:
        world.observer.well = SLOW
        world.notices.record(handed_over(time.time() - ago))
        world.look(20, policy=HANDED)
        assert (world.levels.due is not None) == is_due

    def test_an_obstacle_to_a_switchover_is_reported(self, world: World) -> None:
        world.observer.well = SLOW
        world.look(10, policy=HANDED)
        world.levels.wait(
            "FirstStrategyUnavailable",
            "the first strategy can't be carried out (pool hot has no standby for this workload)",
        )
        assert world.levels.due is None
        world.look(0.3, policy=HANDED)
        assert world.levels.due is not None, "it's tried again"
        assert "pool hot has no standby" in world.notices.conditions["Degraded"][2]

    def test_no_switchover_is_due_without_the_action_in_the_policy(self, world: World) -> None:
        world.observer.well = SLOW
        world.look(100)
        assert world.levels.due is None


STANDBY = Instance(name="w-3", uid="uid-3", pool="hot", running=True, ready=True)
FALLBACK = {"type": "Fallback", "poolRef": {"name": "hot"}}
RESTART = {"type": "Restart"}
LIMITS = {"budget": {"recoveries": 1, "within": "10m"}, "stormGuard": {"holdFor": "1m"}}
PAUSE = {"reason": "a new gripper", "owner": "ann"}


class Deciding:
    """The loop of a monitor whose instance is healthy, idle and, unless it is well, degraded for long enough."""

    def __init__(
        self,
        world: World,
        folder: Path,
        *,
        strategy: dict[str, Any],
        pods: tuple[Instance, ...] = (ACTIVE,),
        well: bool = False,
        storm: bool = False,
        paused: bool = False,
    ) -> None:
        self.policy = policy(HAND_OVER, strategy, limits=LIMITS)
        self.monitor = GivenMonitor(folder)
        objects, observer = self.monitor.objects, self.monitor.observer
        storm_condition = condition("Storm", True, "ManyFail", "4 of 6 workloads fail.")
        objects.put_workload(pause=PAUSE if paused else None)
        objects.put_policy(self.policy, conditions=[storm_condition] if storm else [])
        objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])
        objects.put_pods(*pods)
        objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
        observer.health, observer.well = HEALTHY, HEALTHY if well else SLOW
        self.levels, self.decide = self.monitor.loop.judge.levels, self.monitor.loop.decide
        self._world = world
        self.decide.limits.pauses.update(time.time())
        self.look(10)

    def look(self, seconds: float) -> None:
        """Judge the level for so long."""
        self._world.levels = self.levels
        self._world.look(seconds, policy=self.policy)

    @property
    def waits_for(self) -> str:
        """What the status says that a hand-over waits for."""
        self.look(0.3)
        return self.monitor.notices.conditions["Degraded"][2].partition("No switchover yet: ")[2]


@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        ("", ""),
        ("no standby", "pool hot has no standby for this workload"),
        ("cooldown", "limits.cooldown"),
        ("budget", "limits.budget"),
        ("storm", "4 of 6 workloads fail."),
        ("pause", "a new gripper"),
    ],
)
def test_a_due_switchover_begins_if_its_strategy_is_available_and_the_limits_allow_it(
    world: World, tmp_path: Path, obstacle: str, words: str
) -> None:
    first = FALLBACK if obstacle == "no standby" else RESTART
    deciding = Deciding(world, tmp_path, strategy=first, storm=obstacle == "storm", paused=obstacle == "pause")
    now = time.time()
    if obstacle == "cooldown":
        deciding.decide.limits.retries.after(3600.0)
    if obstacle == "budget":
        deciding.monitor.notices.set_spent([now - 60])
    judgement = Judgement(now, active=ACTIVE, verdict=HEALTHY, degraded=True, last_well=now)
    found = deciding.decide.decide(deciding.policy, judgement, None)
    assert isinstance(found.decision, Recover) == (not obstacle)
    assert found.decision.trigger is Trigger.DEGRADED
    assert (deciding.levels.due is None) == bool(obstacle)
    assert words in deciding.waits_for


def test_a_workload_that_is_well_is_not_switched_over(world: World, tmp_path: Path) -> None:
    deciding, now = Deciding(world, tmp_path, strategy=RESTART, well=True), time.time()
    judgement = Judgement(now, active=ACTIVE, verdict=HEALTHY, degraded=True, last_well=now)
    assert deciding.decide.decide(deciding.policy, judgement, None).decision.trigger is not Trigger.DEGRADED


class CheckedStrategy(Restart):
    """A strategy whose resources are looked for."""

    def __init__(self, takes: float, lacking: str) -> None:
        super().__init__()
        self._takes, self._lacking = takes, lacking

    async def refresh(self, context: StrategyContext) -> None:
        await asyncio.sleep(self._takes)

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        return Availability(not self._lacking, "PoolEmpty" if self._lacking else "", self._lacking)


@pytest.mark.parametrize(
    ("takes", "lacking", "there"),
    [(0.0, "", True), (0.0, "pool spare has no unclaimed pod", False), (9.0, "", False)],
)
async def test_a_due_switchover_is_cancelled_if_its_strategy_is_unavailable_or_slow_to_check(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, takes: float, lacking: str, there: bool
) -> None:
    monkeypatch.setattr(strategy_options, "CHECK_WITHIN", 0.02)
    monkeypatch.setattr(strategy_options, "choices", lambda *_: [Choice(CheckedStrategy(takes, lacking), 5.0)])
    deciding = Deciding(world, tmp_path, strategy=RESTART)
    assert deciding.levels.due is not None
    assert await deciding.decide.confirm() == there
    assert (deciding.levels.due is not None) == there
    assert lacking in deciding.waits_for
