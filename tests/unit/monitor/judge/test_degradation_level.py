"""What a monitor says of a workload that is healthy and not well, and that it keeps its health apart from it."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.notices import RecordedNotices
from tests.unit.monitor.blank_parts import blank_parts, nothing, observer
from understudy.api.conditions import condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.pause_spec import Pause
from understudy.api.kinds.task_spec import TaskStatus
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.limits import pause
from understudy.failover.limits.state import InForce, LimitsInForce
from understudy.failover.progress import Progress
from understudy.monitor.decide import strategy_options
from understudy.monitor.decide.limits import Limits
from understudy.monitor.judge import degradation_level
from understudy.monitor.judge.degradation_level import AGAIN, LOOK, DegradationLevel
from understudy.monitor.judge.degraded_tree import Busy
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.loop import MonitorLoop
from understudy.monitor.notices import BecameDegraded, PublishedStatus
from understudy.monitor.observe.objects.storm_condition import StormCondition
from understudy.trees.core.health_tree import Verdict

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
OTHER = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True)
HEALTHY = Verdict("Healthy", "", "", None)
FAILED = Verdict("Failed", "no /scan for 1 s", "scan", None)
SLOW = Verdict("Failed", "/scan at 8.6 Hz, below 9 Hz over 2 s", "sensors/scan", None)
UNKNOWN = Verdict("Starting", "/scan is starting", "sensors/scan", None)


def policy(**degraded: Any) -> FailurePolicySpec:
    spec: dict[str, Any] = {
        "monitoring": {"yaml": {"topic": {"name": "/scan", "gap": "1s"}}},
        "strategies": [{"type": "Restart"}],
    }
    if degraded:
        spec["degraded"] = degraded
    return FailurePolicySpec.model_validate(spec)


WELL = {"yaml": {"topic": {"name": "/scan", "rate": "> 9 Hz"}}, "debounce": "2s"}
TIGHT = policy(monitoring=WELL, clearAfter="5s")


@dataclass
class World:
    """A clock that the test moves, and what the tree of spec.degraded says."""

    notices: RecordedNotices = field(default_factory=RecordedNotices)
    now: float = 1000.0
    found: Verdict = HEALTHY
    asked: int = 0
    busy: Busy | None = None

    def __post_init__(self) -> None:
        observer: Any = SimpleNamespace(wellness=self._wellness, busy=lambda now, since: self.busy)
        self.levels = DegradationLevel(observer, self.notices)

    def adopt(self, active: str) -> None:
        """Begin as a monitor whose predecessor reported this instance as active and degraded."""
        said = condition("Degraded", True, "NotWell", "/scan at 8.6 Hz.")
        self.notices = RecordedNotices(PublishedStatus(by_type={"Degraded": said}, adopted=active))
        self.__post_init__()

    def _wellness(self, *, now: float, since: float) -> Verdict:
        self.asked += 1
        return self.found

    def look(
        self,
        seconds: float,
        *,
        given: FailurePolicySpec = TIGHT,
        health: Verdict = HEALTHY,
        active: Instance = ACTIVE,
    ) -> bool:
        """Look ten times a second for so long; whether it is degraded at the end."""
        degraded = False
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            degraded = self.levels.look(given, health, active, now=time.time(), since=0.0)
        return degraded

    @property
    def said(self) -> tuple[str, str]:
        return self.notices.conditions["Degraded"][:2]


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    made = World()
    monkeypatch.setattr(degradation_level, "time", SimpleNamespace(monotonic=lambda: made.now, time=time.time))
    return made


def test_it_is_degraded_after_the_debounce_and_well_after_the_clear_time(world: World) -> None:
    assert not world.look(1)
    assert world.said == ("False", "Well")
    world.found = SLOW
    assert not world.look(1.5)
    assert world.look(1)
    assert world.said == ("True", "NotWell")
    assert sum(isinstance(notice, BecameDegraded) for notice in world.notices.log) == 1
    said = world.notices.conditions["Degraded"][2]
    assert said == "/scan at 8.6 Hz, below 9 Hz over 2 s, in leaf sensors/scan of spec.degraded."
    world.found = HEALTHY
    assert world.look(4.5)
    assert not world.look(1)
    assert world.said == ("False", "Well")
    assert [(kind, reason) for kind, reason, _ in world.notices.events] == [
        ("Warning", "Degraded"),
        ("Normal", "WellAgain"),
    ]


def test_nothing_is_asked_of_a_policy_that_does_not_say_what_well_means(world: World) -> None:
    world.found = SLOW
    assert not world.look(10, given=policy())
    assert world.asked == 0
    assert world.notices.conditions == {}


def test_it_is_asked_less_often_than_health_is_looked_at(world: World) -> None:
    world.look(10)
    assert world.asked <= 10 / LOOK + 1


def test_figures_that_change_all_the_time_are_written_seldom(world: World) -> None:
    for hundredth in range(600):
        world.found = Verdict("Failed", f"/scan at 8.{hundredth} Hz", "sensors/scan", None)
        world.look(0.1)
    assert world.notices.changes <= 2 + 60 / AGAIN
    assert len(world.notices.events) == 1


def test_another_leaf_is_told_at_once(world: World) -> None:
    world.found = SLOW
    world.look(3)
    world.found = Verdict("Failed", "/cmd_vel at 15 Hz", "commands", None)
    world.look(0.3)
    assert "in leaf commands" in world.notices.conditions["Degraded"][2]


def test_an_instance_whose_health_fails_is_not_asked_and_is_not_well_by_that(world: World) -> None:
    world.found = SLOW
    world.look(3)
    world.found = HEALTHY
    world.look(4)
    asked = world.asked
    assert world.look(3, health=FAILED), "that it fails doesn't make it well"
    assert world.asked == asked
    assert world.look(4), "and the clear time begins anew"
    assert not world.look(2)


def test_another_instance_is_judged_anew(world: World) -> None:
    world.found = SLOW
    world.look(3)
    world.found = UNKNOWN
    assert not world.look(0.5, active=OTHER)
    assert world.said == ("Unknown", "Starting")
    world.found = HEALTHY
    assert not world.look(0.5, active=OTHER)
    assert world.said == ("False", "Well")


def test_a_new_monitor_goes_on_where_the_last_one_was(world: World) -> None:
    world.adopt("w-1")
    world.found = UNKNOWN
    assert world.look(1)
    world.found = HEALTHY
    assert world.look(4)
    assert not world.look(2)
    assert [reason for _, reason, _ in world.notices.events] == ["WellAgain"], "it is told once that it was degraded"


def test_what_was_said_of_another_instance_by_the_last_monitor_is_not_so_of_this_one(world: World) -> None:
    world.adopt("w-0")
    world.found = UNKNOWN
    assert not world.look(1)
    assert world.said == ("Unknown", "Starting")


def test_with_the_policy_s_word_goes_what_was_said(world: World) -> None:
    world.found = SLOW
    world.look(3)
    assert not world.look(1, given=policy())
    assert "Degraded" not in world.notices.conditions


@pytest.mark.parametrize(
    ("health", "well", "level"),
    [(HEALTHY, SLOW, "Degraded"), (HEALTHY, HEALTHY, "Healthy"), (FAILED, SLOW, "Failed"), (UNKNOWN, SLOW, "Starting")],
)
async def test_the_level_of_a_workload_and_that_it_neither_causes_nor_delays_a_failover(
    health: Verdict, well: Verdict, level: str
) -> None:
    notices, kept = RecordedNotices(), []
    seen = observer(
        verdict=lambda now, since: health,
        wellness=lambda now, since: well,
        deadline=lambda now, since: None,
    )
    at_once = policy(monitoring={**WELL, "debounce": "0s"})
    parts = blank_parts(
        view=SimpleNamespace(policy=at_once, settings=SimpleNamespace(drain=None), spec=None, object=None),
        pods=SimpleNamespace(find=lambda uid: ACTIVE),
        gate=SimpleNamespace(state=GateState(epoch=3, active="w-1", active_uid="uid-1"), exists=True),
        observer=seen,
        notices=notices,
        keeping=SimpleNamespace(judge=lambda state, now: kept.append(state), select=nothing),
    )
    watching = MonitorLoop(parts)
    found = await watching.look(at_once, time.time())
    assert isinstance(found.decision, Recover) == (health is FAILED)
    assert notices.status.health == level
    assert kept[0] == health.state, "state is kept of what is healthy, well or not"


def handed_over(at: float) -> Progress:
    done = Progress.begin("slow", last_healthy=at, detected=at, planned=True)
    done.result = "Recovered"
    return done


RESCHEDULE = {"after": "5s", "idleFor": "3s", "pause": "1m"}
HANDED = policy(monitoring=WELL, clearAfter="10s", actions=[{"reschedule": RESCHEDULE}])
GOAL = Busy("task", "a goal of /go is active")


class TestHandingOver:
    def test_it_is_due_when_it_has_been_degraded_and_idle_for_long_enough(self, world: World) -> None:
        world.found, world.busy = SLOW, GOAL
        world.look(10, given=HANDED)
        assert world.levels.due is None
        assert world.notices.conditions["Degraded"][2].endswith("It is not handed over yet: a goal of /go is active.")
        world.busy = None
        world.look(2.5, given=HANDED)
        assert world.levels.due is None
        world.look(2, given=HANDED)
        assert world.levels.due == (
            "degraded: /scan at 8.6 Hz, below 9 Hz over 2 s, in leaf sensors/scan of spec.degraded; rescheduled while idle"
        )

    def test_idle_means_without_a_break(self, world: World) -> None:
        world.found, world.busy = SLOW, GOAL
        world.look(10, given=HANDED)
        for _ in range(5):
            world.busy = None
            world.look(2.5, given=HANDED)
            world.busy = GOAL
            world.look(0.5, given=HANDED)
        assert world.levels.due is None

    def test_not_before_it_has_been_degraded_for_so_long(self, world: World) -> None:
        world.found = SLOW
        world.look(4.5, given=HANDED)
        assert world.levels.due is None
        world.look(2, given=HANDED)
        assert world.levels.due is not None

    def test_what_shows_at_work_only_is_handed_over_when_the_work_is_done(self, world: World) -> None:
        world.found, world.busy = SLOW, GOAL
        world.look(10, given=HANDED)
        world.found, world.busy = HEALTHY, None
        world.look(4, given=HANDED)
        assert world.levels.due is not None
        world.look(8, given=HANDED)
        assert world.levels.due is None, "it is well by now"

    def test_never_while_health_itself_fails_or_the_tree_can_not_tell(self, world: World) -> None:
        world.found = SLOW
        world.look(10, given=HANDED)
        world.look(0.5, given=HANDED, health=FAILED)
        assert world.levels.due is None
        world.found = UNKNOWN
        world.look(5, given=HANDED)
        assert world.levels.due is None

    def test_goals_that_only_the_proxy_knows_of_and_a_proxy_that_is_away_are_work(self, world: World) -> None:
        world.found = SLOW
        world.notices.set_tasks([TaskStatus(action="/go", active=1)])
        world.look(10, given=HANDED)
        assert world.levels.due is None
        world.notices.set_tasks([])
        world.notices.condition("TasksProxied", "False", "ProxyNotReady", "It can't be reached")
        world.look(10, given=HANDED)
        assert world.levels.due is None
        assert "ProxyNotReady" in world.notices.conditions["Degraded"][2]
        world.notices.condition("TasksProxied", "True", "Serving", "")
        world.look(4, given=HANDED)
        assert world.levels.due is not None

    def test_an_instance_that_is_no_better_is_not_handed_over_again_before_the_pause_is_over(
        self, world: World
    ) -> None:
        world.found = SLOW
        world.look(10, given=HANDED)
        assert world.levels.due is not None
        world.levels.handed_over()
        world.look(40, given=HANDED, active=OTHER)
        assert world.levels.due is None
        assert "less than 1m ago" in world.notices.conditions["Degraded"][2]
        world.look(30, given=HANDED, active=OTHER)
        assert world.levels.due is not None

    @pytest.mark.parametrize(("ago", "is_due"), [(10.0, False), (100.0, True)])
    def test_a_new_monitor_keeps_the_pause_too(self, world: World, ago: float, is_due: bool) -> None:
        world.found = SLOW
        world.notices.record(handed_over(time.time() - ago))
        world.look(20, given=HANDED)
        assert (world.levels.due is not None) == is_due

    def test_what_keeps_it_from_being_begun_is_told(self, world: World) -> None:
        world.found = SLOW
        world.look(10, given=HANDED)
        world.levels.wait(
            "means", "the first strategy can't be carried out (pool hot has no standby for this workload)"
        )
        assert world.levels.due is None
        world.look(0.3, given=HANDED)
        assert world.levels.due is not None, "it's tried again"
        assert "pool hot has no standby" in world.notices.conditions["Degraded"][2]

    def test_one_that_is_not_asked_for_is_never_due(self, world: World) -> None:
        world.found = SLOW
        world.look(100)
        assert world.levels.due is None


def deciding(
    monkeypatch: pytest.MonkeyPatch, waits: list[str], due: str | None, limits: LimitsInForce, **first: Any
) -> MonitorLoop:
    """The loop of a monitor whose workload has a policy with one strategy. ``due`` is why a hand-over is due."""
    strategy = SimpleNamespace(standing=False, **first)
    monkeypatch.setattr(strategy_options, "choices", lambda *_: [SimpleNamespace(strategy=strategy)])
    monkeypatch.setattr(Limits, "in_force", lambda self, now: limits)
    monkeypatch.setattr(StormCondition, "on", lambda self, now: limits.storm)
    monkeypatch.setattr(DegradationLevel, "due", property(lambda self: due))
    monkeypatch.setattr(DegradationLevel, "wait", lambda self, kind, words: waits.append(words))
    view = SimpleNamespace(policy=HANDED, settings=SimpleNamespace(uid="uid-w"), spec=None)
    gate = SimpleNamespace(state=GateState(epoch=3, active="w-1", active_uid="uid-1"), exists=True)
    return MonitorLoop(blank_parts(view=view, gate=gate))


@pytest.mark.parametrize(
    ("due", "available", "not_before", "spent", "storm", "paused", "planned"),
    [
        ("degraded: slow", None, 0.0, None, None, None, True),
        (None, None, 0.0, None, None, None, False),
        ("degraded: slow", "pool hot has no standby for this workload", 0.0, None, None, None, False),
        ("degraded: slow", None, 2e10, None, None, None, False),
        ("degraded: slow", None, 0.0, 2e10, None, None, False),
        ("degraded: slow", None, 0.0, None, "4 of 6 workloads fail.", None, False),
        ("degraded: slow", None, 0.0, None, None, Pause(reason="a new gripper", owner="ann"), False),
    ],
)
def test_a_hand_over_is_begun_like_a_failure_once_the_first_strategy_is_there_and_the_limits_allow_it(
    monkeypatch: pytest.MonkeyPatch,
    due: str | None,
    available: str | None,
    not_before: float,
    spent: float | None,
    storm: str | None,
    paused: Pause | None,
    planned: bool,
) -> None:
    waits: list[str] = []
    now = time.time()
    in_force = LimitsInForce(
        pause=pause.in_force(paused, now),
        waiting=InForce(until=not_before) if not_before else None,
        storm=InForce(storm) if storm else None,
        budget=InForce(until=spent) if spent else None,
    )
    loop = deciding(monkeypatch, waits, due, in_force, outlook=lambda means: available)
    judgement = Judgement(now, active=ACTIVE, verdict=HEALTHY, degraded=True, last_well=now)
    found = loop.decide.decide(HANDED, judgement, None)
    assert isinstance(found.decision, Recover) == planned
    assert (found.decision.trigger is Trigger.DEGRADED) == (due is not None)
    assert len(waits) == (1 if due and not planned else 0)
    assert all(available in words for words in waits if available)


@pytest.mark.parametrize(
    ("takes", "available", "there"),
    [(0.0, None, True), (0.0, "pool spare has no unclaimed pod", False), (9.0, None, False)],
)
async def test_a_hand_over_that_is_due_is_not_begun_where_a_look_finds_otherwise_or_takes_too_long(
    monkeypatch: pytest.MonkeyPatch, takes: float, available: str | None, there: bool
) -> None:
    async def look(means: object) -> None:
        await asyncio.sleep(takes)

    monkeypatch.setattr(strategy_options, "LOOK_WITHIN", 0.02)
    waits: list[str] = []
    loop = deciding(monkeypatch, waits, "degraded: slow", LimitsInForce(), look=look, available=lambda means: available)
    found = await loop.decide.confirm()
    assert (found, len(waits)) == (there, 0 if there else 1)
