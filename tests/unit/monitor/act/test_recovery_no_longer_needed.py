"""A failure is judged again if its first commit is delayed: a monitor that was cut off from the robot saw silence."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import replace
from pathlib import Path

import aiohttp
import pytest

from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.failover import reflex
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance, NoLongerNeeded
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.reflex import ReflexSwitch
from understudy.monitor import loop
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge import reassessment
from understudy.monitor.judge.failure_detection import Failure
from understudy.trees.core.health_tree import Verdict

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
HEALTHY = Verdict("Healthy", "", "", None)
FAILED = Verdict("Failed", "no /cmd_vel", "/cmd_vel", 1.0)


class CutOff:
    """A monitor that decides on a recovery while it reaches neither the robot nor the API server."""

    def __init__(self, folder: Path) -> None:
        monitor = GivenMonitor(folder)
        self.objects, self.observer, self.loop = monitor.objects, monitor.observer, monitor.loop
        self.objects.put_workload()
        self.objects.put_policy(policy_of({"type": "Restart", "verifyWithin": "1s"}))
        self.objects.put_settings()
        self.objects.put_pods(ACTIVE)
        self.objects.put_gate(GateState(epoch=4, active=ACTIVE.name, active_uid=ACTIVE.uid))
        self.observer.health = FAILED
        self.answers(False)

    def answers(self, reachable: bool) -> None:
        error = None if reachable else aiohttp.ClientConnectionError("unreachable")
        self.objects.client.failing = lambda method, name: error

    async def recover(self) -> None:
        """Recover until the gate was switched, or until the recovery ends."""
        now = time.time()
        failure = Failure("no /cmd_vel", now - 0.5, now, Trigger.HEALTH_FAILED)
        recovering = asyncio.create_task(self.loop.carry_through(Resolution(Recover("HealthFailed"), failure)))
        try:
            async with asyncio.timeout(5):
                while not recovering.done() and self.objects.gate.state.epoch == 4:
                    await asyncio.sleep(0.01)
        finally:
            recovering.cancel()
            await asyncio.gather(recovering, return_exceptions=True)

    @property
    def fenced(self) -> bool:
        return self.objects.gate.state.closed


@pytest.fixture
def monitor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CutOff:
    monkeypatch.setattr(reassessment, "OLD", 0.3)
    return CutOff(tmp_path)


def later(monitor: CutOff, verdict: Verdict, *, seconds: float = 0.4) -> None:
    """The robot is heard again after this time, and the API server answers 0.2 s later."""
    running = asyncio.get_running_loop()
    running.call_later(seconds, setattr, monitor.observer, "health", verdict)
    running.call_later(seconds + 0.2, monitor.answers, True)


async def test_an_instance_that_is_healthy_again_is_neither_fenced_nor_deleted(monitor: CutOff) -> None:
    later(monitor, HEALTHY)
    await monitor.recover()
    assert (monitor.objects.gate.state.active, monitor.objects.gate.state.epoch) == (ACTIVE.name, 4)
    assert monitor.objects.deleted == []
    notices = monitor.objects.notices
    assert notices.status.by_type["Recovering"].reason == "HealthyAgain"
    assert "no /cmd_vel" in notices.status.by_type["Recovering"].message
    assert "RecoveryNotNeeded" in notices.reasons
    assert notices.status.recoveries == ()


@pytest.mark.parametrize("phase", [0.06, 0.08])
async def test_an_instance_that_is_heard_again_a_moment_after_the_api_server_is_not_fenced(
    monitor: CutOff, phase: float
) -> None:
    """As if one link to both of them was cut."""
    running = asyncio.get_running_loop()
    running.call_later(0.7 + phase, monitor.answers, True)
    running.call_later(0.73 + phase, setattr, monitor.observer, "health", HEALTHY)
    await monitor.recover()
    assert monitor.objects.gate.state.active == ACTIVE.name


async def test_an_instance_that_stays_silent_is_fenced_once_the_api_server_answers(monitor: CutOff) -> None:
    later(monitor, FAILED)
    await monitor.recover()
    assert monitor.fenced


async def test_a_first_try_that_is_answered_is_not_delayed_by_a_second_judgement(monitor: CutOff) -> None:
    monitor.observer.health = HEALTHY
    monitor.answers(True)
    await monitor.recover()
    assert monitor.fenced


@pytest.mark.parametrize("lost", [replace(ACTIVE, terminating=True), replace(ACTIVE, running=False)])
async def test_a_lost_pod_stays_failed_although_it_is_heard(monitor: CutOff, lost: Instance) -> None:
    monitor.objects.put_pods(lost)
    later(monitor, HEALTHY)
    await monitor.recover()
    assert monitor.fenced


async def test_a_process_that_restarted_meanwhile_stays_failed_because_its_state_is_lost(monitor: CutOff) -> None:
    monitor.observer.restarted.add(ACTIVE.name)
    later(monitor, HEALTHY)
    await monitor.recover()
    assert monitor.fenced


@pytest.mark.parametrize("is_back", [True, False])
async def test_after_the_mux_is_back_at_a_healthy_instance_that_is_not_fenced_for_a_standby(
    monitor: CutOff, monkeypatch: pytest.MonkeyPatch, is_back: bool
) -> None:
    """The standby that took over failed too, and the instance on board gave control back (seed 3253319)."""
    monkeypatch.setattr(monitor.objects.proof, "is_back", lambda active: is_back)
    standby = ReflexSwitch(PodIdentity(name="w-2", uid="uid-2"), time.time() - 0.5, time.time() - 0.2)
    progress = reflex.begin(standby, PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid), 0.3)
    monitor.observer.health = HEALTHY
    monitor.answers(True)
    async with monitor.loop.judge.reassessment.during(progress):
        await asyncio.sleep(0.4)
        with pytest.raises(NoLongerNeeded) if is_back else contextlib.nullcontext():
            await monitor.objects.gate.commit(None, progress)
    assert monitor.fenced != is_back


async def test_a_recovery_that_has_committed_goes_on(monitor: CutOff) -> None:
    failed = [PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)]
    progress = Progress.begin("no /cmd_vel", last_healthy=1.0, detected=1.5, failed=failed)
    monitor.objects.put_gate(GateState(epoch=5, active=ACTIVE.name, active_uid=ACTIVE.uid, recovery=progress))
    monitor.observer.health = HEALTHY
    monitor.answers(True)
    async with monitor.loop.judge.reassessment.during(progress):
        await asyncio.sleep(0.4)
        assert progress.healthy_again
        await monitor.objects.gate.commit(None, progress)
    assert monitor.fenced


@pytest.mark.parametrize(("verdict", "is_fenced"), [(HEALTHY, False), (FAILED, True)])
async def test_a_monitor_that_continues_a_recovery_listens_before_it_fences(
    monitor: CutOff, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: Verdict, is_fenced: bool
) -> None:
    """The monitor that decided it ended before the gate was switched, and its decision may be old."""
    monkeypatch.setattr(loop, "SETTLE", 0.2)
    failed = [PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)]
    decided = Progress.begin("no /cmd_vel", last_healthy=time.time() - 20, detected=time.time() - 19, failed=failed)
    Journal(tmp_path / "recovery.json").save(decided)
    monitor.answers(True)
    monitor.observer.health = verdict
    await resumed(monitor)
    assert monitor.fenced == is_fenced
    assert ("RecoveryNotNeeded" in monitor.objects.notices.reasons) != is_fenced


@pytest.mark.parametrize(("verdict", "is_fenced"), [(HEALTHY, False), (FAILED, True)])
async def test_a_monitor_that_continues_a_recovery_listens_to_the_instance_that_was_too_slow(
    monitor: CutOff, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: Verdict, is_fenced: bool
) -> None:
    """The monitor that gave it up ended before it fenced it, and it may drive by now (seed 559501)."""
    monkeypatch.setattr(loop, "SETTLE", 0.2)
    first, slow = PodIdentity(name="w-0", uid="uid-0"), PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)
    attempt = Progress.begin("no /cmd_vel", last_healthy=time.time() - 20, detected=time.time() - 19, failed=[first])
    attempt.target, attempt.strategy = slow, "Restart"
    monitor.objects.put_gate(GateState(epoch=5, active=slow.name, active_uid=slow.uid, recovery=attempt))
    given_up = attempt.model_copy(deep=True)
    given_up.fail_target()
    Journal(tmp_path / "recovery.json").save(given_up)
    monitor.answers(True)
    monitor.observer.health = verdict
    await resumed(monitor)
    assert monitor.fenced == is_fenced


async def resumed(monitor: CutOff) -> None:
    """Let a new monitor continue the recovery for a moment."""
    resuming = asyncio.create_task(monitor.loop.resume())
    await asyncio.sleep(0.8)
    resuming.cancel()
    await asyncio.gather(resuming, return_exceptions=True)
