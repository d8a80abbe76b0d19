"""What a monitor does about an instance that reaches the robot although the gate does not let it through."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.limited_monitor import World
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api import names
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import REPLICA_SETS, ApiError
from understudy.kube.gates.base import Reach
from understudy.monitor.act.gate import gate_opening, leak_response
from understudy.monitor.judge import sole_driver
from understudy.monitor.judge.sole_driver import MEMORY, QUIET
from understudy.monitor.notices import LeaksCounted, StatusAwaited
from understudy.monitor.observe.robot.known_senders import KnownSender, OutputSender
from understudy.monitor.outcome import Outcome
from understudy.trees.core.health_tree import Verdict

FORMER = Instance("w-1", "uid-1", ip="10.0.0.1", running=True, ready=True)
ACTIVE = Instance("w-2", "uid-2", ip="10.0.0.2", pool="hot", running=True, ready=True)
STANDBY = Instance("w-3", "uid-3", ip="10.0.0.3", pool="hot", running=True, ready=True)
HEALTHY = Verdict("Healthy", "", "", None)


class Driven:
    """A workload that w-2 drives after w-1, and whose monitor looks every 0.2 s."""

    def __init__(
        self, folder: Path, *pods: Instance, on_leak: Literal["Close", "Continue"] = "Close", pause: Pause | None = None
    ) -> None:
        self.monitor = GivenMonitor(folder)
        self.objects, self.observer, self.notices = (
            self.monitor.objects,
            self.monitor.observer,
            self.monitor.notices,
        )
        self.policy = policy_of({"type": "Fallback", "poolRef": {"name": "hot"}}, onLeak=on_leak)
        self.objects.put_workload(pause=pause.to_wire() if pause is not None else None)
        self.objects.put_policy(self.policy)
        self.objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])
        self.objects.put_pods(*pods)
        self.observer.health = HEALTHY
        self.now = time.time() - 600
        self.put_gate("w-1")

    def put_gate(self, active: str) -> None:
        uid = f"uid-{active[2:]}" if active else ""
        epoch = self.objects.gate.state.epoch + 1
        self.objects.put_gate(GateState(epoch=epoch, active=active, active_uid=uid))

    async def look(self, seconds: float = 0.2) -> None:
        self.now += seconds
        self.monitor.loop.decide.limits.pauses.update(self.now)
        await self.monitor.loop.evaluate(self.policy, self.now)
        await asyncio.sleep(0)

    async def hear(self, *instances: Instance, times: int = 10) -> None:
        """Look ten times in two seconds, while instances are heard."""
        for _ in range(times):
            at = self.now + 0.2
            self.observer.heard = [OutputSender("/cmd_vel", i.name, i.uid, (i.uid,), at) for i in instances]
            await self.look()
        for _ in range(20):  # what runs in the background
            await asyncio.sleep(0)

    async def restarting(self) -> asyncio.Task[None]:
        """Begin a recovery that waits until another pod runs, which does not happen. Returns the monitor's task."""
        self.objects.put_policy(policy_of({"type": "Restart"}))
        self.objects.client.store(REPLICA_SETS, "fleet", {"metadata": {"name": "w"}, "spec": {"replicas": 1}})
        self.observer.health = Verdict("Failed", "no /cmd_vel for 500 ms", "", time.time())
        running = asyncio.create_task(self.monitor.loop.run())
        async with asyncio.timeout(5):
            while not self.objects.gate.state.closed:
                await asyncio.sleep(0.01)
        return running

    def conclude(self, *, verified: float) -> None:
        """A recovery ends, in which w-2 took over from w-1."""
        failed = [PodIdentity(name="w-1", uid="uid-1")]
        progress = Progress.begin("it ended", last_healthy=verified - 3, detected=verified - 2, failed=failed)
        progress.result, progress.target = "Recovered", PodIdentity(name="w-2", uid="uid-2")
        progress.moments |= {"committing": verified - 1.0, "first_output": verified - 0.5, "verified": verified}
        self.monitor.loop.conclude(Outcome("Recovered", progress, self.policy))

    @property
    def commits(self) -> Sequence[str]:
        return [name for name, _ in self.objects.commits]

    @property
    def graces(self) -> list[Any]:
        deletions = [options for method, _, options in self.objects.client.requests if method == "DELETE"]
        return [(options["uid"], options["grace_seconds"]) for options in deletions]


async def switched(folder: Path, *pods: Instance, **more: Any) -> Driven:
    found = Driven(folder, *pods, **more)
    await found.look()
    found.put_gate("w-2")
    await found.look()
    assert found.notices.status.health == "Healthy"
    return found


async def test_a_former_instance_that_goes_on_sending_is_deleted_and_the_gate_closes_until_it_is_silent(
    tmp_path: Path,
) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    await driven.hear(FORMER, ACTIVE)
    assert driven.graces == [("uid-1", 1)]
    assert driven.commits == [""]
    assert driven.notices.status.health == "Failed"
    assert {"SeveralDrivers", "LeakingPodDeleted", "GateClosedForLeak"} <= set(driven.notices.reasons)
    assert driven.notices.conditions["SoleDriver"][:2] == ("False", "FormerDriver")
    await driven.hear(FORMER)
    assert driven.commits == [""], "it may not open for another one beside it"
    driven.observer.heard = []
    await driven.look(QUIET + 1)
    assert driven.commits == ["", "w-2"], "and opens for the instance that it was closed for, not for the older w-1"
    assert driven.graces == [("uid-1", 1)], "w-2 did nothing wrong"


async def test_the_gate_keeps_the_identity_of_a_leaking_instance_that_was_never_let_through(tmp_path: Path) -> None:
    leaving = replace(STANDBY, terminating=True)
    driven = await switched(tmp_path, ACTIVE, leaving)
    driven.observer.senders = [KnownSender("w-3", "uid-3", "10.0.0.3", driven.now, listed=False)]
    await driven.hear(leaving, ACTIVE)
    assert driven.commits == [""]
    assert [pod.uid for pod in driven.objects.gate.state.pinned][:2] == ["uid-2", "uid-3"], "a new monitor knows it too"


async def test_safe_commands_are_due_while_the_gate_is_closed_for_a_leak(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    unattended = driven.monitor.loop.act.unattended
    assert unattended.since is None
    await driven.hear(FORMER, ACTIVE)
    assert driven.objects.gate.state.closed
    assert unattended.since is not None
    driven.observer.heard = []
    await driven.look(QUIET + 1)
    await driven.look()
    assert driven.notices.status.health == "Healthy"
    assert unattended.since is None


async def test_a_pod_that_is_being_deleted_slowly_is_ended_at_once(tmp_path: Path) -> None:
    leaving = Instance("w-1", "uid-1", ip="10.0.0.1", running=True, terminating=True)
    driven = await switched(tmp_path, leaving, ACTIVE)
    await driven.hear(leaving)
    assert driven.graces == [("uid-1", 1)]


async def test_the_policy_may_have_the_active_instance_continue_and_the_status_is_never_healthy(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE, on_leak="Continue")
    await driven.hear(FORMER, ACTIVE)
    assert (driven.commits, driven.graces) == ([], [("uid-1", 1)])
    assert driven.notices.status.health == "Degraded"
    assert driven.notices.conditions["Healthy"][:2] == ("False", "SeveralDrivers")
    driven.observer.heard = []
    await driven.look(QUIET + 1)
    assert driven.notices.status.health == "Healthy"


async def test_a_vanished_instance_closes_the_gate_too(tmp_path: Path) -> None:
    driven = await switched(tmp_path, ACTIVE)
    driven.observer.senders = [KnownSender("w-1", "uid-1", "10.0.0.1", driven.now, listed=False, pinned=True)]
    await driven.hear(FORMER)
    assert (driven.commits, driven.objects.deleted) == ([""], [])


async def test_a_standby_that_was_never_in_control_is_deleted_and_the_active_instance_drives_on(tmp_path: Path) -> None:
    driven = await switched(tmp_path, ACTIVE, STANDBY)
    await driven.hear(STANDBY, ACTIVE, times=40)
    assert (driven.commits, driven.graces) == ([], [("uid-3", 1)]), "once a minute, since a network may enforce nothing"
    assert driven.notices.status.health == "Degraded"


async def test_a_standby_that_ends_with_its_deletion_closes_no_gate(tmp_path: Path) -> None:
    driven = await switched(tmp_path, STANDBY, ACTIVE)
    await driven.hear(STANDBY, ACTIVE, times=30)
    assert driven.graces == [("uid-3", 1)]
    driven.objects.put_pods(replace(STANDBY, terminating=True), ACTIVE)
    await driven.hear(STANDBY, ACTIVE, times=2)  # what was on its way
    await driven.hear(ACTIVE, times=20)
    assert driven.commits == []


async def test_a_standby_that_is_seldom_heard_ends_with_its_deletion_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its test packets came once a second. The last one left just after the monitor had decided to delete it (campaign 59)."""
    driven = await switched(tmp_path, STANDBY, ACTIVE)
    monkeypatch.setattr(leak_response, "time", SimpleNamespace(monotonic=lambda: driven.now))
    while not driven.graces:
        await driven.hear(STANDBY, ACTIVE, times=1)
        for _ in range(4):
            await driven.look()
    driven.objects.put_pods(replace(STANDBY, terminating=True), ACTIVE)
    await driven.hear(STANDBY, ACTIVE, times=1)
    for _ in range(30):
        await driven.look()
    assert driven.commits == []
    await driven.hear(STANDBY, ACTIVE, times=6)
    assert driven.commits == [""], "it goes on after all"


async def test_a_standby_that_goes_on_sending_after_its_deletion_closes_the_gate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = await switched(tmp_path, STANDBY, ACTIVE)
    await driven.hear(STANDBY, ACTIVE, times=30)
    driven.objects.put_pods(replace(STANDBY, terminating=True), ACTIVE)
    monkeypatch.setattr(leak_response, "STANDBY_ENDS", 0.0)
    await driven.hear(STANDBY, ACTIVE, times=2)
    assert driven.commits == [""]


async def test_nothing_is_done_about_a_leak_during_a_pause(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE, pause=Pause(reason="a new gripper", owner="ann"))
    await driven.hear(FORMER, ACTIVE)
    assert (driven.commits, driven.graces) == ([], [])
    assert driven.notices.conditions["SoleDriver"][0] == "False", "it is reported"


async def test_a_gate_that_could_not_be_closed_is_closed_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leak_response, "CLOSE_AGAIN", 0.0)
    driven = await switched(tmp_path, FORMER, ACTIVE)
    driven.objects.client.failing = lambda method, name: ApiError(403, "Forbidden", "not now")
    await driven.hear(FORMER, ACTIVE)
    assert driven.notices.status.health == "Degraded"
    driven.objects.client.failing = lambda method, name: None
    await driven.hear(FORMER, ACTIVE)
    assert driven.objects.gate.state.closed


async def test_the_gate_is_asked_to_close_at_most_once_a_second(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    driven.objects.client.failing = lambda method, name: ApiError(403, "Forbidden", "not now")
    await driven.hear(FORMER, ACTIVE, times=20)
    assert driven.commits == [""]


async def test_a_leak_that_has_ended_closes_no_gate(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    await driven.hear(FORMER, ACTIVE, times=5)
    assert driven.commits == []
    driven.observer.heard = [OutputSender("/cmd_vel", "w-1", "uid-1", ("uid-1",), driven.now + 0.2)]
    await driven.look(1.5)
    assert driven.notices.conditions["SoleDriver"][:2] == ("False", "SeveralDrivers"), "it was heard a moment ago"
    assert driven.commits == []


async def test_a_leak_that_a_recovery_saw_end_closes_no_gate(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    for _ in range(8):
        driven.now += 0.2
        driven.observer.heard = [OutputSender("/cmd_vel", "w-1", "uid-1", ("uid-1",), driven.now)]
        driven.monitor.loop.judge.sole_driver.track(driven.objects.pods.of_workload(), driven.now)
    driven.conclude(verified=driven.now + 0.15)  # of one period and the margin
    await driven.look()
    assert driven.commits == []
    assert driven.notices.conditions["SoleDriver"][0] == "True"
    await driven.hear(FORMER)
    assert driven.commits == [""], "it goes on after all"


async def test_a_leak_that_outlasts_a_recovery_closes_the_gate_at_once(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    verified = driven.now
    for _ in range(8):
        driven.now += 0.2
        driven.observer.heard = [OutputSender("/cmd_vel", "w-1", "uid-1", ("uid-1",), driven.now)]
        driven.monitor.loop.judge.sole_driver.track(driven.objects.pods.of_workload(), driven.now)
    driven.conclude(verified=verified)
    await driven.look()
    assert driven.commits == [""]


async def test_a_leak_during_a_hold_is_reported_and_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sole_driver, "LASTS", 0.3)
    world = World(monkeypatch, tmp_path)
    world.spend()
    world.monitor.observer.health = Verdict("Failed", "no /cmd_vel", "topic", time.time() - 1)
    running = asyncio.create_task(world.loop.run())
    await world.until(lambda: world.objects.gate.state.closed)

    def ended() -> bool:
        world.monitor.observer.heard = [OutputSender("/cmd_vel", "w-1", "uid-1", ("uid-1",), time.time())]
        return world.objects.deleted == ["w-1"]

    await world.until(ended)
    running.cancel()
    assert world.notices.conditions["SoleDriver"][:2] == ("False", "FormerDriver")
    assert LeaksCounted(1) in world.notices.log


async def test_a_leak_of_the_failed_instance_is_ended_while_its_recovery_waits_for_a_pod(tmp_path: Path) -> None:
    driven = await switched(tmp_path, FORMER, STANDBY, ACTIVE)
    current = driven.monitor.senses.current
    failed = [PodIdentity(name="w-1", uid="uid-1")]
    for _ in range(10):
        driven.now += 0.2
        heard = [OutputSender("/cmd_vel", i.name, i.uid, (i.uid,), driven.now) for i in (FORMER, STANDBY)]
        driven.observer.heard = heard
        driven.monitor.loop.judge.sole_driver.update(driven.objects.pods.of_workload(), driven.now)
        with current.during(Progress.begin("it fails", last_healthy=1.0, detected=2.0, failed=failed)):
            driven.monitor.loop.act.leaks.respond_during(current, driven.now)
    for _ in range(20):
        await asyncio.sleep(0)
    assert driven.graces == [("uid-1", 1)]


async def test_an_open_gate_is_reported_during_a_recovery(tmp_path: Path) -> None:
    driven = Driven(tmp_path, FORMER)
    objects = driven.objects
    running = await driven.restarting()
    async with asyncio.timeout(5):
        while driven.notices.conditions.get("GateEnforced", ())[:2] != ("False", "NotEnforced"):
            objects.packets["uid-1"] = time.time()
            await asyncio.sleep(0.05)
    running.cancel()
    assert StatusAwaited() in driven.notices.log, "it does not wait for the end of the recovery"


async def test_an_edited_gate_is_restored_during_a_recovery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also after a look for leaks that ended with an error."""
    driven = Driven(tmp_path, FORMER)
    follow, failed = driven.monitor.loop.act.labels.follow, iter([True])

    def failing_once() -> None:
        if driven.objects.gate.state.closed and next(failed, False):
            raise RuntimeError
        follow()

    monkeypatch.setattr(driven.monitor.loop.act.labels, "follow", failing_once)
    objects, kind = driven.objects, driven.objects.view.gate_kind
    running = await driven.restarting()
    async with asyncio.timeout(5):
        edited = {**objects.view.gates.items["w-gate"], **kind.routing("w", "w-1")}
        objects.view.gates.put(objects.client.store(kind.resource, "fleet", edited))
        while kind.let_through(objects.view.gates.items["w-gate"]) != ():
            await asyncio.sleep(0.01)
        new = kind.closed("w", Reach(), epoch=objects.gate.state.epoch)
        objects.view.gates.put(
            objects.client.store(
                kind.resource, "fleet", {**edited, **new, "metadata": {**edited["metadata"], **new["metadata"]}}
            )
        )
        while objects.gate.state.recovery is None:
            await asyncio.sleep(0.01)
    running.cancel()
    assert objects.gate.state.closed


async def test_the_status_has_the_epoch_of_a_commit_while_the_recovery_goes_on(tmp_path: Path) -> None:
    """The operator makes a deleted gate again at this epoch."""
    driven = Driven(tmp_path, FORMER)
    driven.objects.put_policy(policy_of({"type": "Restart"}))
    driven.objects.client.store(REPLICA_SETS, "fleet", {"metadata": {"name": "w"}, "spec": {"replicas": 1}})
    driven.observer.health = Verdict("Failed", "no /cmd_vel for 500 ms", "", time.time())
    running = asyncio.create_task(driven.monitor.loop.run())
    async with asyncio.timeout(5):
        while not driven.objects.gate.state.closed:
            await asyncio.sleep(0.01)
    await asyncio.sleep(0)
    epoch = driven.notices.status.gate.epoch
    running.cancel()
    assert epoch == driven.objects.gate.state.epoch > 1


async def test_a_new_monitor_listens_before_it_opens_a_closed_gate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = await switched(tmp_path, FORMER, ACTIVE)
    await first.objects.gate.commit(ACTIVE, None)
    await first.objects.gate.commit(None, None)
    pinned = first.objects.gate.state.pinned
    assert PinnedPod(name="w-2", uid="uid-2", ip="10.0.0.2") in pinned
    gate = first.objects.view.gates.items["w-gate"]
    second = Driven(tmp_path, FORMER, ACTIVE)
    second.objects.view.gates.put(second.objects.client.store(second.objects.view.gate_kind.resource, "fleet", gate))
    await second.look()
    assert second.commits == []
    monkeypatch.setattr(sole_driver, "LISTEN", 0.0)
    await second.look()
    assert second.commits == ["w-2"], "the last driver"


async def test_after_an_outage_a_closed_gate_does_not_open_before_the_monitor_has_listened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = await switched(tmp_path, FORMER, ACTIVE)
    pinned = tuple(PinnedPod(name=pod.name, uid=pod.uid, ip=pod.ip) for pod in (ACTIVE, FORMER))
    driven.objects.put_gate(replace(driven.objects.gate.state, pinned=pinned))
    await driven.hear(FORMER, ACTIVE)
    assert driven.commits == [""]
    monkeypatch.setattr(gate_opening, "OPEN_WITHIN", 0.02)
    monkeypatch.setattr(gate_opening, "OPEN_AGAIN", 0.0)
    monkeypatch.setattr(sole_driver, "CUT_OFF", 0.0)
    monkeypatch.setattr(sole_driver, "LISTEN", 0.0)  # the monitor is not new
    # The network of the monitor's node is down: it hears nobody, and the API server does not answer.
    driven.observer.heard = []
    driven.objects.client.failing = lambda method, name: OSError("unreachable") if name == "w-gate" else None
    await driven.look(QUIET + 1)
    tried = len(driven.commits)
    assert tried > 1
    await driven.look()
    assert len(driven.commits) == tried, "it only asks whether the API server answers"
    monkeypatch.setattr(sole_driver, "LISTEN", 2.0)
    driven.objects.client.failing = lambda method, name: None
    await driven.look()  # it answers
    await driven.look()
    patches = [body for method, name, body in driven.objects.client.requests if (method, name) == ("PATCH", "w-gate")]
    sent = next(body for body in patches if body["metadata"]["annotations"].get(names.ACTIVE) == "w-2")
    with pytest.raises(ApiError, match="409"):  # the network may deliver it only now
        await driven.objects.client.patch(driven.objects.view.gate_kind.resource, "fleet", "w-gate", sent)
    assert driven.objects.gate.state.closed, "w-1 may drive, and is not heard yet"
    await driven.hear(FORMER)
    monkeypatch.setattr(sole_driver, "LISTEN", 0.0)
    await driven.look()
    assert driven.objects.gate.state.closed
    driven.observer.heard = []
    await driven.look(MEMORY)
    assert driven.objects.gate.state.active == "w-2"
