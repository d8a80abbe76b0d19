"""What follows from a recovery that is over: from when on the next one's samples count, and when something may be begun again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.notices import RecordedNotices
from tests.unit.monitor.test_trying_again import policy, took_over
from understudy.failover.interfaces import GateState, Superseded
from understudy.failover.limits.backoff import FIRST as BACKOFF_FIRST
from understudy.failover.progress import Progress
from understudy.monitor.act import recovery_outcome
from understudy.monitor.act.recovery_outcome import Aftermath
from understudy.monitor.act.safe_commands import Unattended
from understudy.monitor.decide import retry_backoff
from understudy.monitor.decide.deferred_failures import Postponing
from understudy.monitor.decide.limits import Limits
from understudy.monitor.judge import failure_detection
from understudy.monitor.judge.failure_detection import Detector

NOW = 1_000_000.0
COMMITTED = NOW - 0.3


class World:
    """The end of a recovery by which w-1 has come to drive."""

    def __init__(self, **more: Any) -> None:
        self.policy = policy(**more)
        view: Any = SimpleNamespace(policy=self.policy, settings=SimpleNamespace(), spec=None, object=None)
        nothing: Any = SimpleNamespace(tell=lambda _: None, note=lambda _: None, remember=lambda: None)
        gate: Any = SimpleNamespace(state=GateState(epoch=4, active="w-1", active_uid="uid-1"))
        self.ended: list[str] = []
        switching: Any = SimpleNamespace(done=lambda progress, text: self.ended.append(text))
        self.told = RecordedNotices()
        self.detector = Detector(nothing, gate, nothing, nothing)
        self.limits = Limits(view, self.told)
        self.unattended = Unattended()
        self.aftermath = Aftermath(
            gate,
            self.told,
            nothing,
            self.detector,
            self.limits,
            Postponing(self.told, self.limits, nothing),
            self.unattended,
            nothing,
            nothing,
            switching,
        )
        self.unattended.nothing_verified(NOW - 9)
        self.detector.since = NOW - 100
        self.detector.counts_from(NOW - 100, self.policy.monitoring)

    def waits(self) -> float:
        """Seconds for which nothing is begun yet."""
        return self.limits.retries.not_before - NOW


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (recovery_outcome, failure_detection, retry_backoff):
        monkeypatch.setattr(module, "time", SimpleNamespace(time=lambda: NOW))


def over(result: str) -> Progress:
    done = took_over(0, NOW)
    done.moments["committing"] = COMMITTED
    return done.model_copy(update={"result": result})


@pytest.mark.parametrize(("priority", "wait"), [("Normal", 7.0), ("Safety", 0.0)])
def test_an_instance_that_took_over_is_watched_from_the_commit_and_the_cooldown_runs(
    priority: str, wait: float
) -> None:
    world = World(priority=priority, limits={"cooldown": "7s"})
    world.aftermath.recovered(over("Recovered"), world.policy)
    assert (world.detector.since, world.waits(), world.unattended.since) == (COMMITTED, wait, None)
    assert world.detector.counts_from(NOW, world.policy.monitoring) >= NOW, "what failed before was another instance"
    assert world.told.conditions["Recovering"][:2] == ("False", "Recovered")
    assert (world.told.status.health, world.told.status.active) == ("Healthy", "w-1")


def test_where_nothing_was_verified_nobody_drives_and_it_is_tried_again_later() -> None:
    world = World()
    world.unattended.driven()
    for wait in (BACKOFF_FIRST, 2 * BACKOFF_FIRST):
        world.aftermath.recovered(over("Failed"), world.policy)
        assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, wait, NOW)
    assert world.told.conditions["Recovering"][:2] == ("False", "NothingVerified")
    assert world.told.status.health == "Failed"


def test_whoever_acts_at_a_newer_epoch_drives_and_is_watched_at_once() -> None:
    world = World()
    world.aftermath.superseded(over("Running"), Superseded("the gate is at epoch 9"))
    assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, 0.0, None)
    assert world.told.conditions["Recovering"][1] == "Superseded"


def test_what_the_api_server_refused_is_tried_again_in_a_moment() -> None:
    world = World()
    world.aftermath.stopped(over("Running"), OSError("no route"))
    assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, BACKOFF_FIRST, NOW - 9)
    assert world.told.conditions["Recovering"][1] == "Error"


@pytest.mark.parametrize(
    ("result", "since", "event"), [("Recovered", COMMITTED, "SwitchedOver"), ("Failed", NOW, "SwitchoverNotDone")]
)
def test_a_switchover_leaves_what_was_put_off_before(result: str, since: float, event: str) -> None:
    world = World()
    world.limits.retries.after(5.0)
    world.aftermath.switched(over(result))
    assert (world.detector.since, world.waits(), world.unattended.since) == (since, 5.0, None)
    assert [reason for _, reason, _ in world.told.events] == [event]
    assert len(world.ended) == 1
