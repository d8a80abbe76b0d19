"""While no pod is in control and none is being recovered, the gate is opened for one that runs."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.unit.failover.world import Store, World
from tests.unit.monitor.cluster_objects import NAMESPACE
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.pause_spec import Pause
from understudy.api.protocol.kept_state import KeptSample, KeptState
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance, NoLongerNeeded
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import REPLICA_SETS, ApiError
from understudy.monitor.act.gate.gate_opening import ASK_AGAIN
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.decide.initial_activation import InitialActivation
from understudy.monitor.outcome import Outcome

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
POLICY = FailurePolicySpec.model_validate(
    {
        "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
        "strategies": [{"type": "Restart"}],
    }
)


class Closed:
    """The loop of a monitor whose gate is closed."""

    def __init__(
        self, folder: Path, *instances: Instance, left: Progress | None = None, paused: Pause | None = None
    ) -> None:
        monitor = GivenMonitor(folder)
        self.objects, self._loop, self.options = monitor.objects, monitor.loop, monitor.loop.decide.options
        self.conclude = monitor.loop.conclude
        self.objects.put_workload(pause=paused.to_wire() if paused is not None else None)
        self.objects.put_policy(POLICY)
        self.objects.put_settings()
        self.objects.put_pods(*instances)
        self.objects.put_gate(GateState(epoch=4, recovery=left))
        self.objects.client.store(REPLICA_SETS, NAMESPACE, {"metadata": {"name": "w"}, "spec": {"replicas": 0}})

    @property
    def requested(self) -> int:
        """How often a pod was requested of the workload's own controller."""
        return sum((method, name) == ("PATCH", "w") for method, name, _ in self.objects.client.requests)

    async def open(self) -> None:
        await self._loop.act.opening.open(ACTIVE)

    async def look(self, now: float) -> bool:
        """Look once; whether the gate was opened."""
        before = len(self.objects.commits)
        self._loop.decide.limits.pauses.update(now)
        await self._loop.evaluate(POLICY, now)
        return len(self.objects.commits) > before


@pytest.mark.parametrize("left", [(), (replace(ACTIVE, terminating=True),), (replace(ACTIVE, running=False),)])
async def test_a_pod_is_requested_repeatedly_while_none_runs_and_none_is_recovered(
    tmp_path: Path, left: tuple[Instance, ...]
) -> None:
    # The operator may have scaled the workload's own ReplicaSet to none, for a pod of a shared pool that drove then.
    closed = Closed(tmp_path, *left)
    assert not await closed.look(1000.0)
    assert closed.requested == 1
    await closed.look(1000.1)
    assert closed.requested == 1, "not with every look"
    closed.objects.client.failing = lambda method, name: ApiError(403, "Forbidden", "not yet")
    await closed.look(1000.0 + ASK_AGAIN)
    await closed.look(1000.0 + 2 * ASK_AGAIN)
    assert closed.requested == 3, "again and again, until one comes"
    await closed.look(1000.0 - 3600)
    assert closed.requested == 4, "also after the clock was set back"


async def test_opening_the_gate_after_a_failed_recovery_keeps_the_list_of_failed_pods(tmp_path: Path) -> None:
    failed = [PodIdentity(name="w-0", uid="uid-0"), PodIdentity(name="w-1", uid="uid-1")]
    left = Progress.begin("it ended", last_healthy=0.0, detected=0.0, failed=failed)
    closed = Closed(tmp_path, ACTIVE, left=left)
    closed.objects.notices.record(left.model_copy(update={"result": "Failed"}))
    assert await closed.look(1000.0)
    ((target, progress),) = closed.objects.commits
    assert target == "w-1"
    assert progress is not None
    assert ([pod.name for pod in progress.failed], progress.result) == (["w-0"], "Failed"), "nobody continues it"


@pytest.mark.parametrize("is_first_failure", [True, False])
async def test_opening_the_gate_for_another_instance_counts_the_last_driver_as_failed(
    tmp_path: Path, is_first_failure: bool
) -> None:
    # It may have failed just before the gate closed for a leak, when nobody had noticed that yet.
    monitor = GivenMonitor(tmp_path)
    objects = monitor.objects
    failed = [PodIdentity(name="w-0", uid="uid-0")]
    left = None if is_first_failure else Progress.begin("it ended", last_healthy=0.0, detected=0.0, failed=failed)
    pinned = tuple(PinnedPod(name=f"w-{number}", uid=f"uid-{number}", ip=f"10.0.0.{number}") for number in (3, 0))
    objects.put_gate(GateState(epoch=4, recovery=left, pinned=pinned))
    await monitor.loop.act.opening.open(ACTIVE)
    ((target, progress),) = objects.commits
    assert progress is not None
    assert progress.result == "Failed", "nobody continues it"
    assert (target, [pod.name for pod in progress.failed]) == ("w-1", ["w-3"] if is_first_failure else ["w-0", "w-3"])


async def test_an_instance_that_failed_while_somebody_deleted_the_gate_counts_as_failed(tmp_path: Path) -> None:
    closed = Closed(tmp_path, ACTIVE)
    progress = Progress.begin("it ended", last_healthy=7.0, detected=8.0, failed=[PodIdentity(name="w-3", uid="uid-3")])
    progress.open_at = 4
    closed.conclude(Outcome("NoLongerNeeded", progress, None, NoLongerNeeded("somebody deleted the gate")))
    await closed.open()
    ((target, committed),) = closed.objects.commits
    assert committed is not None
    assert (target, [pod.name for pod in committed.failed]) == ("w-1", ["w-3"])


KEPT = KeptState(
    samples=(KeptSample(topic="/progress", type="std_msgs/msg/Int64", to="/resume", taken_at=1.0, data=b""),)
)


NOW = 99.0


@pytest.mark.parametrize(("last_driver", "onsets"), [("w-0", [7.0]), ("w-1", []), ("w-3", [NOW])])
async def test_an_instance_is_given_what_was_kept_before_the_last_driver_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_driver: str, onsets: list[float]
) -> None:
    is_given = bool(onsets)
    monkeypatch.setattr(CLOCK, "now", lambda: NOW)
    left = Progress.begin("it ended", last_healthy=7.0, detected=8.0, failed=[PodIdentity(name="w-0", uid="uid-0")])
    closed = Closed(tmp_path, ACTIVE, left=left)
    closed.objects.notices.record(left.model_copy(update={"result": "Failed"}))
    uid = last_driver.replace("w", "uid")
    pinned = (PinnedPod(name=last_driver, uid=uid, ip="10.0.0.1"),)
    closed.objects.put_gate(GateState(epoch=4, recovery=left, pinned=pinned))
    asked: list[float] = []
    world = World(Store())

    def kept(onset: float) -> KeptState:
        asked.append(onset)
        return KEPT

    context = replace(world.context(), kept=kept)
    monkeypatch.setattr(closed.options, "context", lambda: context)
    await closed.open()
    assert len(closed.objects.commits) == (0 if is_given else 1), "it is decided again after that"
    await closed.open()
    assert [target for target, _ in closed.objects.commits][:1] == ["w-1"]
    assert world.store.kept_states == ({"w-1": KEPT} if is_given else {})
    assert asked == onsets
    conditions = closed.objects.notices.status.by_type
    assert ("StateRestored" in conditions) == is_given


async def test_the_instance_that_drove_drives_again_after_somebody_deleted_the_gate(tmp_path: Path) -> None:
    standby = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", pool="hot", running=True, ready=True)
    closed = Closed(tmp_path, ACTIVE, standby)
    closed.objects.put_gate(GateState(epoch=4, active=standby.name, active_uid=standby.uid))
    await closed.look(1000.0)
    closed.objects.put_gate(GateState(epoch=4))
    assert await closed.look(1000.1)
    assert [target for target, _ in closed.objects.commits] == ["w-2"], (
        "and not the pod of the workload's own controller"
    )


async def test_no_state_is_given_before_the_api_server_answers_that_has_to_open_the_gate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = Progress.begin("it ended", last_healthy=7.0, detected=8.0, failed=[PodIdentity(name="w-0", uid="uid-0")])
    closed = Closed(tmp_path, ACTIVE, left=left)
    world = World(Store(kept=KEPT))
    monkeypatch.setattr(closed.options, "context", world.context)
    monkeypatch.setattr(GateControl, "unanswered_since", 1.0)
    await closed.open()
    assert (world.store.kept_states, closed.objects.commits) == ({}, [])


async def test_a_pod_that_has_just_started_drives_once_it_is_ready_or_has_had_time_for_it() -> None:
    store = Store()
    pod = store.add("w-1", ready=False)

    context, grace = World(store).context(), seconds(POLICY.monitoring.startup_grace) / 2
    activation = InitialActivation(context.instances, context.agents)  # type: ignore[arg-type]
    long_after = time.time() + 10 * grace

    def ready(seconds: float) -> list[str]:
        return [one.name for one in activation.candidates(POLICY, long_after + seconds, paused=False).ready]

    assert ready(0.0) == ready(grace) == []
    assert ready(grace + 0.1) == ["w-1"]
    store.pods.clear()
    ready(grace + 0.2)
    store.pods[pod.name] = pod
    assert ready(grace + 0.3) == []
    store.answering.add("w-1")
    assert ready(grace + 0.4) == ["w-1"]


async def test_no_instance_is_activated_during_a_pause(tmp_path: Path) -> None:
    closed = Closed(tmp_path, ACTIVE, paused=Pause(reason="a new gripper", owner="ann"))
    assert not await closed.look(1000.0)
    assert closed.objects.commits == []
