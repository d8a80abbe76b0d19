"""What follows from a recovery that is over: from when on the next one's samples count, and when something may be begun again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.support.clock import Clock
from tests.unit.monitor.monitors import GivenMonitor
from tests.unit.monitor.takeovers import policy, took_over
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance, Superseded
from understudy.failover.limits.backoff import FIRST as BACKOFF_FIRST
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.decide import retry_backoff
from understudy.monitor.judge import failure_detection
from understudy.monitor.outcome import Kind, Outcome

NOW = 1_000_000.0
COMMITTED = NOW - 0.3
STANDBY = Instance(name="w-2", uid="uid-2", pool="hot", running=True)


class World:
    """The end of a recovery that activated w-1."""

    def __init__(self, folder: Path, **more: Any) -> None:
        self.policy = policy(**more)
        monitor = GivenMonitor(folder)
        self.notices, loop = monitor.notices, monitor.loop
        monitor.objects.put_workload()
        monitor.objects.put_policy(self.policy)
        monitor.objects.put_settings()
        monitor.objects.put_gate(GateState(epoch=4, active="w-1", active_uid="uid-1"))
        self.objects, self.garbage = monitor.objects, loop.act.garbage
        self.conclude, self.limits = loop.conclude, loop.decide.limits
        self.detector, self.unattended = loop.judge.detector, loop.act.unattended
        self.unattended.conclude(Outcome("NothingVerified", over("Failed")))
        self.detector.restart(NOW - 100)
        self.detector.counts_from(NOW - 100, self.policy.monitoring)

    def end(self, kind: Kind, *, error: Exception | None = None) -> None:
        result = "Recovered" if kind in ("Recovered", "SwitchedOver") else "Failed"
        known = self.policy if kind in ("Recovered", "NothingVerified") else None
        progress = over(result if error is None else "Running")
        if kind in ("SwitchedOver", "NotSwitchedOver"):
            progress.switchover = "Failover"
        self.conclude(Outcome(kind, progress, known, error))

    def waits(self) -> float:
        """Seconds for which nothing is begun yet."""
        return self.limits.retries.not_before - NOW


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (failure_detection, retry_backoff):
        monkeypatch.setattr(module, "time", Clock(NOW))
    monkeypatch.setattr(CLOCK, "now", lambda: NOW)


def over(result: str) -> Progress:
    done = took_over(0, NOW)
    done.moments["committing"] = COMMITTED
    if result != "Recovered":
        del done.moments["verified"]
        done.moments["fenced"] = NOW
    return done.model_copy(update={"result": result})


@pytest.mark.parametrize(("priority", "wait"), [("Normal", 7.0), ("Safety", 0.0)])
def test_after_a_recovery_the_instance_is_watched_from_the_commit_and_the_cooldown_runs(
    tmp_path: Path, priority: str, wait: float
) -> None:
    world = World(tmp_path, priority=priority, limits={"cooldown": "7s"})
    world.end("Recovered")
    assert (world.detector.since, world.waits(), world.unattended.since) == (COMMITTED, wait, None)
    assert world.detector.counts_from(NOW, world.policy.monitoring) >= NOW, "what failed before was another instance"
    assert world.notices.conditions["Recovering"][:2] == ("False", "Recovered")
    assert (world.notices.status.health, world.notices.status.active) == ("Healthy", "w-1")


def test_after_a_recovery_without_a_verified_instance_a_backoff_runs(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.unattended.driven()
    for wait in (BACKOFF_FIRST, 2 * BACKOFF_FIRST):
        world.end("NothingVerified")
        assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, wait, NOW)
    assert world.notices.conditions["Recovering"][:2] == ("False", "NothingVerified")
    assert world.notices.status.health == "Failed"


def test_after_a_superseded_recovery_the_active_instance_is_watched_at_once(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.end("Superseded", error=Superseded("the gate is at epoch 9"))
    assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, 0.0, None)
    assert world.notices.conditions["Recovering"][1] == "Superseded"


@pytest.mark.parametrize("has_fenced", [True, False])
def test_a_pod_that_a_superseded_recovery_had_fenced_counts_as_failed(tmp_path: Path, has_fenced: bool) -> None:
    # Somebody may have deleted the gate, and with it the record of that.
    world = World(tmp_path)
    progress = over("Running")
    progress.failed = [PodIdentity(name=STANDBY.name, uid=STANDBY.uid)]
    progress.moments = {"committed": NOW} if has_fenced else {}
    world.objects.put_pods(STANDBY)
    world.conclude(Outcome("Superseded", progress, None, Superseded("the gate admits no pod")))
    assert [pod.name for pod in world.garbage.failed()] == ([STANDBY.name] if has_fenced else [])


def test_a_pod_whose_deletion_failed_is_remembered_although_somebody_has_fenced_the_robot_since(tmp_path: Path) -> None:
    world = World(tmp_path)
    progress = over("Recovered")
    progress.failed = [PodIdentity(name=STANDBY.name, uid=STANDBY.uid)]
    world.objects.put_pods(STANDBY)
    world.objects.put_gate(GateState(epoch=9))
    world.conclude(Outcome("Recovered", progress, world.policy))
    assert [pod.name for pod in world.garbage.failed()] == [STANDBY.name]


def test_after_an_error_of_the_api_server_the_recovery_is_retried_soon(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.end("Stopped", error=OSError("no route"))
    assert (world.detector.since, world.waits(), world.unattended.since) == (NOW, BACKOFF_FIRST, NOW)
    assert world.notices.conditions["Recovering"][1] == "Error"


@pytest.mark.parametrize(
    ("kind", "since", "event"),
    [("SwitchedOver", COMMITTED, "SwitchedOver"), ("NotSwitchedOver", NOW, "SwitchoverNotDone")],
)
def test_a_switchover_does_not_end_a_backoff(tmp_path: Path, kind: Kind, since: float, event: str) -> None:
    world = World(tmp_path)
    world.limits.retries.after(5.0)
    world.end(kind)
    assert (world.detector.since, world.waits(), world.unattended.since) == (since, 5.0, None)
    assert [reason for _, reason, _ in world.notices.events] == [event]
    assert world.notices.status.switchover is not None
