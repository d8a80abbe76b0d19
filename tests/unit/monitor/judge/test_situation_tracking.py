"""In which situation a monitor sees its robot, what must be watched for that, and how seldom it is said."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import pytest
from prometheus_client import REGISTRY

pytest.importorskip("rclpy")

from tests.support.notices import RecordedNotices
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.situation_spec import SituationStatus
from understudy.monitor.judge import situation_tracking as situations
from understudy.monitor.judge.situation_tracking import CHECK_PERIOD, HEARING, SituationTracking
from understudy.monitor.notices import PublishedStatus
from understudy.monitor.observe.robot.context_detection import ContextDetection, SituationState
from understudy.monitor.report import monitor_metrics
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord

STATUS = "/carry/_action/status"
TASK = {"task": {"action": "/carry"}}
LOADED = {"yaml": {"topic": {"name": "/loaded", "gap": "1s"}}}
HEALTHY = Verdict("Healthy", "", "", None)
FAILED = Verdict("Failed", "no /scan for 1 s", "scan", None)


def policy(**situations: Any) -> FailurePolicySpec:
    return FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/scan", "gap": "1s"}}},
            "strategies": [{"type": "Restart"}],
            "situations": [
                {"name": name, "when": when, "clearAfter": "5s", "strategies": [{"type": "Restart"}]}
                for name, when in situations.items()
            ],
        }
    )


NONE, CARRYING = policy(), policy(carrying=TASK)


class TestContextDetection:
    @staticmethod
    def seen(found: ContextDetection, observed: RecordedObservations, *goals: str) -> dict[str, SituationState]:
        now = time.time()
        return found.states(observed, goals, now=now, since=now - 100)

    @pytest.fixture
    def found(self) -> ContextDetection:
        made = ContextDetection()
        assert made.follow(policy(carrying=TASK, loaded=LOADED))
        return made

    def test_a_policy_without_situations_watches_no_topics(self) -> None:
        made = ContextDetection()
        assert not made.follow(NONE)
        assert made.topics == []

    def test_the_status_of_the_task_and_the_topics_of_the_tree_are_watched(self, found: ContextDetection) -> None:
        assert {topic.name for topic in found.topics} == {STATUS, "/loaded"}
        assert next(topic for topic in found.topics if topic.name == STATUS).task

    def test_an_unchanged_policy_is_not_loaded_again(self, found: ContextDetection) -> None:
        assert not found.follow(policy(carrying=TASK, loaded=LOADED))
        assert found.follow(CARRYING)
        assert [topic.name for topic in found.topics] == [STATUS]

    def test_a_situation_with_a_task_applies_while_a_goal_is_active(self, found: ContextDetection) -> None:
        assert self.seen(found, RecordedObservations({}))["carrying"] == SituationState(False, "")
        active = self.seen(found, RecordedObservations({}, {STATUS: 1.0}))["carrying"]
        assert active == SituationState(True, "a goal of /carry is active")

    def test_a_situation_with_a_task_applies_while_a_goal_waits_for_the_next_instance(
        self, found: ContextDetection
    ) -> None:
        assert self.seen(found, RecordedObservations({}), "/carry")["carrying"].so
        assert not self.seen(found, RecordedObservations({}), "/other")["carrying"].so

    def test_a_situation_with_a_tree_applies_while_the_tree_holds(self, found: ContextDetection) -> None:
        assert self.seen(found, RecordedObservations({}))["loaded"].so is False, "without a grace"
        received = TopicRecord()
        received.add(time.time())
        beat = RecordedObservations({"/loaded": received})
        assert self.seen(found, beat)["loaded"] == SituationState(True, "its tree holds")

    def test_a_situation_with_unwatched_topics_is_unknown(self, found: ContextDetection) -> None:
        found.leave_out({"/loaded"})
        assert self.seen(found, RecordedObservations({}))["loaded"].so is None

    def test_a_tree_that_does_not_load_leaves_the_last_one_in_force(self, found: ContextDetection) -> None:
        assert found.follow(policy(loaded={"yaml": {"topik": {}}}))
        assert [topic.name for topic in found.topics] == ["/loaded"]
        assert found.problems[0].startswith("The tree of situation loaded does not load")


@dataclass
class World:
    """A clock that the test moves, and what is seen."""

    notices: RecordedNotices = field(default_factory=RecordedNotices)
    now: float = 1000.0
    so: dict[str, bool | None] = field(default_factory=dict)
    asked: int = 0

    def situations_of(self) -> dict[str, SituationState]:
        return {name: SituationState(so, f"{name} it is" if so else "") for name, so in self.so.items()}

    def pass_(self, length: float, asked: FailurePolicySpec = CARRYING, verdict: Verdict = HEALTHY) -> str:
        end = self.now + length
        while self.now < end:
            self.now += CHECK_PERIOD / 2
            self.situations.update(asked, verdict, now=self.now + 1e9, since=1e9)
        return self.notices.status.situation.name if self.notices.status.situation is not None else ""


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return made(monkeypatch)


def made(monkeypatch: pytest.MonkeyPatch, status: PublishedStatus | None = None) -> World:
    found = World(RecordedNotices(status))

    class Sight:
        def situations(self, goals: Any, *, now: float, since: float) -> dict[str, SituationState]:
            found.asked += 1
            return found.situations_of()

    found.situations = SituationTracking(Sight(), found.notices)  # type: ignore[arg-type]
    monkeypatch.setattr(situations.time, "monotonic", lambda: found.now)
    return found


def metric(world: World, name: str) -> float | None:
    for notice in world.notices.log:
        monitor_metrics.count(notice)
    return REGISTRY.get_sample_value("understudy_situation", {"situation": name})


def test_the_begin_and_end_of_a_situation_are_reported_once(world: World) -> None:
    world.so = {"carrying": False}
    assert world.pass_(HEARING + 1) == ""
    assert world.notices.changes == 0
    world.so = {"carrying": True}
    assert world.pass_(60) == "carrying"
    assert world.notices.status.situation is not None
    assert world.notices.status.situation.reason == "carrying it is"
    assert world.notices.changes == 1
    assert metric(world, "carrying") == 1.0
    world.so = {"carrying": False}
    assert world.pass_(4) == "carrying"
    assert world.pass_(2) == ""
    assert world.pass_(60) == ""
    assert world.notices.changes == 2
    assert metric(world, "carrying") is None
    assert [(kind, reason) for kind, reason, _ in world.notices.events] == [("Normal", "SituationChanged")] * 2
    assert ["carrying" in message for _, _, message in world.notices.events] == [True, True]


def test_without_situations_nothing_is_evaluated(world: World) -> None:
    assert world.pass_(10, NONE) == ""
    assert (world.asked, world.notices.changes) == (0, 0)


def test_a_situation_ends_at_once_if_the_policy_no_longer_has_it(world: World) -> None:
    world.so = {"carrying": True}
    assert world.pass_(1) == "carrying"
    assert world.pass_(0.1, NONE) == ""


def test_a_situation_stays_while_the_instance_fails(world: World) -> None:
    world.so = {"carrying": True}
    assert world.pass_(HEARING + 1) == "carrying"
    world.so = {"carrying": False}
    assert world.pass_(100, verdict=FAILED) == "carrying"
    assert world.pass_(4) == "carrying", "its goals come back to the next one"
    assert world.pass_(2) == ""


def test_a_new_monitor_keeps_the_situation_until_it_knows_the_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    status = SituationStatus(name="carrying", since="2026-01-01T00:00:00Z", reason="it was")
    world = made(monkeypatch, PublishedStatus(situation=status))
    world.so = {"carrying": False}
    assert world.pass_(HEARING - 1) == "carrying"
    world.so = {"carrying": True}
    assert world.pass_(30) == "carrying"
    assert world.notices.changes == 0, "it is the same one still"
    world.so = {"carrying": False}
    assert world.pass_(6) == ""


def test_the_next_situation_is_in_force_when_the_first_ends(world: World) -> None:
    both = policy(carrying=TASK, loaded=LOADED)
    world.so = {"carrying": True, "loaded": True}
    assert world.pass_(HEARING + 1, both) == "carrying"
    world.so = {"carrying": False, "loaded": True}
    assert world.pass_(6, both) == "loaded"
    assert world.notices.changes == 2
