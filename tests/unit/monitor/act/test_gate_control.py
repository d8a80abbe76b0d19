"""The gate as the monitor commits it: over what its recovery knew, and over nothing that somebody else has done since."""

from __future__ import annotations

import asyncio
import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import pytest

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import ClusterObjects, workload_spec
from tests.unit.monitor.gates import Packets
from tests.unit.monitor.gates import gate as open_gate
from understudy.api import names
from understudy.api.kinds.pause_spec import FENCE
from understudy.cli.control.fence import fencing
from understudy.failover import pinned
from understudy.failover.abandoned import AbandonedRecovery
from understudy.failover.interfaces import GateState, Instance, NoLongerNeeded, Superseded
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies import steps
from understudy.failover.strategies.base import StrategyContext
from understudy.kube.client import NETWORK_POLICIES, WORKLOADS, ApiError, Object
from understudy.kube.gates.base import GateRecord, OwnSwitch, Reach
from understudy.kube.gates.kinds.network_policy import GATE
from understudy.monitor.act.objects import gate_control
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

FAILED = Instance(name="w-1", uid="u1")
STANDBY = Instance(name="w-2", uid="u2")
THIRD = Instance(name="w-3", uid="u3")


def recovery(failed: Instance = FAILED) -> Progress:
    return Progress.begin(
        "it ended", last_healthy=1.0, detected=2.0, failed=[PodIdentity(name=failed.name, uid=failed.uid)]
    )


async def by_another(
    client: MemoryClient, found: ClusterView, pod: Instance | None, *, noticed: bool = True, kept: bool = False
) -> None:
    """Another writer commits, such as a second monitor or who fences by hand; this monitor's watch brings it, or hasn't yet.

    The recovery that stands beside the gate is ``kept`` by who knows of epochs only.
    """
    over = GateRecord.of(await client.get(NETWORK_POLICIES, "fleet", "w-gate"))
    name, uid = (pod.name, pod.uid) if pod else ("", "")
    beside = over.recovery if kept else ""
    patch = GATE.commitment("w", over=over, active=name, active_uid=uid, recovery=beside)
    policy = await GATE.write(client, "fleet", "w", patch)
    if noticed:
        found.gates.put(policy)


@pytest.fixture
def client() -> MemoryClient:
    return MemoryClient()


@pytest.fixture
def found(client: MemoryClient) -> ClusterView:
    return ClusterView(client, "fleet", "w", Wakeups())


async def test_a_recovery_commits_after_it_closed_the_gate(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    await gate.commit(None, progress)
    await gate.commit(STANDBY, progress)
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 6)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("noticed", [True, False])
@pytest.mark.parametrize("other", [THIRD, None])
async def test_a_commit_of_somebody_else_is_not_undone(
    client: MemoryClient, found: ClusterView, tmp_path: Path, other: Instance | None, noticed: bool, kept: bool
) -> None:
    """Else a pod that drives would be shut out with nobody to delete it, or one that a person has fenced be let through."""
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    await gate.commit(None, progress)
    await by_another(client, found, other, noticed=noticed, kept=kept)
    with pytest.raises(Superseded, match=r"another process changed the gate to epoch 6"):
        await gate.commit(STANDBY, progress)
    assert (gate.state.active, gate.state.epoch) == (other.name if other else "", 6)


async def test_a_commit_that_ends_the_recovery_of_another_monitor_keeps_the_pods_that_failed_in_it(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, other, progress = await open_gate(client, found, tmp_path, STANDBY), recovery(STANDBY), recovery()
    await gate.commit(None, other)
    await gate.commit(THIRD, progress)
    assert [pod.name for pod in progress.failed] == [FAILED.name, STANDBY.name]
    third = recovery(THIRD)
    await gate.commit(None, third)
    await gate.commit(STANDBY, following := recovery())
    assert [pod.name for pod in following.failed] == [FAILED.name, THIRD.name], "not the one that it lets through"


async def test_a_recovery_is_superseded_if_that_of_another_monitor_has_closed_the_gate_since_it_began(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    """It was decided long ago if its monitor was cut off from the API server, and would restore what it kept until then."""
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    progress.open_at = gate.state.epoch
    await gate.commit(None, other := recovery())
    with pytest.raises(Superseded, match=f"recovery {other.id}"):
        await steps.close(progress, cast("StrategyContext", SimpleNamespace(gate=gate)))
    assert (gate.state.recovery or progress).id == other.id


async def test_a_commit_keeps_the_pods_that_failed_in_another_monitors_part_of_the_same_recovery(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    progress.monitor = PodIdentity(name="monitor-1", uid="m1")
    await gate.commit(None, progress)
    successor = PodIdentity(name="monitor-2", uid="m2")
    successors = progress.model_copy(update={"monitor": successor, "failed": list(progress.failed)})
    progress.fail(PodIdentity(name=STANDBY.name, uid=STANDBY.uid))
    await gate.commit(None, progress)  # carried out after the successor has read the record
    await gate.commit(THIRD, successors)
    assert [pod.name for pod in successors.failed] == [FAILED.name, STANDBY.name]


async def test_a_recovery_does_not_shut_out_a_pod_that_it_is_not_about(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    await by_another(client, found, THIRD)
    with pytest.raises(Superseded, match=r"another process changed the gate, which now admits w-3"):
        await gate.commit(None, progress)
    assert gate.state.active == THIRD.name


@pytest.mark.parametrize("what", ["target", "former", "taken_over"])
async def test_a_resumed_recovery_continues_with_its_own_pod(
    client: MemoryClient, found: ClusterView, tmp_path: Path, what: str
) -> None:
    progress = recovery().model_copy(update={what: PodIdentity(name=STANDBY.name, uid=STANDBY.uid)})
    gate = await open_gate(client, found, tmp_path, STANDBY)
    await gate.commit(STANDBY, progress)
    assert gate.state.epoch == 5


async def test_an_unanswered_commit_that_took_effect_counts_as_own(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    real = GATE.write

    async def unanswered(*arguments: Any, **named: Any) -> Object:
        found.gates.put(await real(*arguments, **named))
        raise RuntimeError("given up in its time")

    monkeypatch.setattr(GATE, "write", unanswered)
    with pytest.raises(RuntimeError):
        await gate.commit(None, progress)
    monkeypatch.setattr(GATE, "write", real)
    await gate.commit(STANDBY, progress)
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 6)


async def test_a_commit_whose_answer_was_lost_is_own_also_if_the_watch_has_not_shown_it_when_the_next_strategy_commits(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the recovery is given up, and never recorded (model seed 3324061)."""
    gate, progress, real = await open_gate(client, found, tmp_path, FAILED), recovery(), GATE.write

    async def unanswered(*arguments: Any, **named: Any) -> Object:
        await real(*arguments, **named)
        raise RuntimeError("given up in its time")

    monkeypatch.setattr(GATE, "write", unanswered)
    with pytest.raises(RuntimeError):
        await gate.commit(STANDBY, progress)
    monkeypatch.setattr(GATE, "write", real)
    assert gate.state.epoch == 4, "the watch is half-open"
    await gate.commit(THIRD, progress)
    assert (gate.state.active, gate.state.epoch) == (THIRD.name, 6)


async def test_after_a_failed_recovery_the_gate_opens_over_any_commit(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    await gate.commit(None, progress)
    await by_another(client, found, None)
    await gate.commit(THIRD, progress.model_copy(update={"result": "Failed"}))
    assert gate.state.active == THIRD.name


def addressed(name: str, uid: str, ip: str) -> Instance:
    return Instance(name=name, uid=uid, ip=ip, running=True)


async def test_the_gate_keeps_the_identities_of_whom_it_let_through() -> None:
    first, second, third = (addressed(f"w-{i}", f"u{i}", f"10.0.0.{i}") for i in (1, 2, 3))
    objects = ClusterObjects()
    objects.put_pods(first, second, third)
    objects.put_gate(GateState(epoch=4, active="w-1", active_uid="u1"))  # by a version that kept no identities
    progress = recovery(first)
    await objects.gate.commit(second, progress)
    assert [(pod.name, pod.uid, pod.ip) for pod in objects.gate.state.pinned] == [
        ("w-2", "u2", "10.0.0.2"),
        ("w-1", "u1", "10.0.0.1"),
    ]
    objects.put_pods(third)
    await objects.gate.commit(None, progress)
    assert [pod.uid for pod in objects.gate.state.pinned] == ["u2", "u1"], "although their pods are gone"
    await objects.gate.commit(third, progress.model_copy(update={"result": "Failed"}))
    assert [pod.uid for pod in objects.gate.state.pinned] == ["u3", "u2", "u1"]
    writes = [method for method, name, _ in objects.client.requests if name == objects.gate_name]
    assert writes == ["PATCH"] * 3, "it costs no further write"


async def test_an_admitted_standby_is_kept_too() -> None:
    first, second = (addressed(f"w-{i}", f"u{i}", f"10.0.0.{i}") for i in (1, 2))
    objects = ClusterObjects()
    objects.put_pods(first, second)
    objects.put_gate(GateState(epoch=4, active="w-1", active_uid="u1"))
    await objects.gate.admit(second)
    await objects.gate.admit(None)
    assert {pod.uid for pod in objects.gate.state.pinned} == {"u1", "u2"}


def test_the_list_of_identities_is_bounded_and_an_invalid_one_is_ignored() -> None:
    pods = [pinned.PinnedPod(name=f"w-{i}", uid=f"u{i}", ip="10.0.0.1") for i in range(2 * pinned.MOST)]
    kept: tuple[pinned.PinnedPod, ...] = ()
    for pod in pods:
        kept = pinned.with_pods(kept, pod)
    assert [pod.uid for pod in kept] == [pod.uid for pod in reversed(pods[-pinned.MOST :])]
    assert pinned.read(pinned.write(kept)) == kept
    assert pinned.read("[{") == pinned.read("") == ()


EDITS: list[Object] = [
    {"matchLabels": {names.INSTANCE: "w-2"}},
    {"matchExpressions": None},
    {"matchLabels": {"app": "other"}},
    {"matchExpressions": [{"key": "app", "operator": "Exists"}]},
]


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("state", [GateState(epoch=4, active="w-1", active_uid="u1"), GateState(epoch=4)])
async def test_a_gate_that_somebody_edited_lets_through_again_whom_its_record_names(
    state: GateState, edit: Object
) -> None:
    objects = ClusterObjects()
    objects.put_gate(state)
    view, kind = objects.view, objects.view.gate_kind
    assert view.gate_object is not None
    before = view.gate_object["spec"]
    assert not await objects.gate.restore_routing(), "nobody edited it yet"
    edited = await objects.client.patch(
        kind.resource, view.namespace, objects.gate_name, {"spec": {"podSelector": edit}}
    )
    view.gates.put(edited)
    assert await objects.gate.restore_routing()
    assert view.gate_object["spec"] == before
    assert objects.gate.state.epoch == 4
    assert "GateRestored" in objects.notices.reasons
    assert not await objects.gate.restore_routing(), "once is enough"


async def test_a_gate_that_nobody_edited_is_not_written() -> None:
    objects = ClusterObjects()
    for state in (
        GateState(epoch=4),
        GateState(epoch=4, active="w-1", active_uid="u1"),
        GateState(epoch=4, active="w-1", active_uid="u1", admitted="w-2", admitted_uid="u2"),
    ):
        objects.put_gate(state)
        assert not await objects.gate.restore_routing()


@pytest.mark.parametrize("status", [409, 429, 503])
async def test_a_commit_that_the_api_server_refuses_for_now_is_repeated_with_pauses(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    monkeypatch.setattr(gate_control, "RETRY_FIRST", 0.05)
    gate, loop = await open_gate(client, found, tmp_path, FAILED), asyncio.get_running_loop()
    asked: list[float] = []

    def refuse(method: str, name: str) -> Exception | None:
        if method == "PATCH":
            asked.append(loop.time())
        return ApiError(status, "Refused", "later") if method == "PATCH" and len(asked) < 4 else None

    client.failing = refuse
    await gate.commit(None, recovery())
    assert gate.state.closed
    assert asked[-1] - asked[0] >= 0.05 + 0.1


async def test_a_commit_on_a_dead_connection_is_sent_again(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate_control, "TRY_WITHIN", 0.1)
    gate = await open_gate(client, found, tmp_path, FAILED)
    client.hang_once(monkeypatch)
    async with asyncio.timeout(5):
        await gate.commit(STANDBY, recovery())
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 5)


@pytest.mark.parametrize(("generation", "paused"), [(6, False), (7, True)])
async def test_a_gate_that_a_user_has_fenced_stays_closed_until_the_pause_has_ended(
    client: MemoryClient, found: ClusterView, tmp_path: Path, generation: int, paused: bool
) -> None:
    """Also for a monitor that has received neither the pause, since its watch is half-open, nor the closed gate."""
    gate = await open_gate(client, found, tmp_path, FAILED)

    def workload(generation: int, **spec: Any) -> None:
        item = {"metadata": {"name": "w", "generation": generation}, "spec": workload_spec(**spec)}
        found.workloads.put(client.store(WORKLOADS, "fleet", item))

    workload(generation, **({"pause": {"owner": "ann", "reason": f"{FENCE}it is in the way"}} if paused else {}))
    over = GateRecord.of(await client.get(NETWORK_POLICIES, "fleet", "w-gate"))
    await GATE.write(client, "fleet", "w", fencing(GATE, "w", over, 7))
    with pytest.raises(Superseded):
        await gate.commit(STANDBY, recovery())
    assert gate.record is not None
    assert (gate.record.fenced, gate.state.closed) == (7, True)
    with pytest.raises(Superseded, match="a user has fenced the robot"):
        await gate.commit(STANDBY, None)
    workload(8)
    await gate.commit(STANDBY, None)
    assert (gate.state.active, gate.record.fenced) == (STANDBY.name, 0)


async def test_a_commit_over_a_gate_that_was_written_meanwhile_is_repeated_at_once(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate_control, "RETRY_FIRST", 60.0)
    gate = await open_gate(client, found, tmp_path, FAILED)
    await client.patch(NETWORK_POLICIES, "fleet", "w-gate", {"metadata": {"labels": {"app": "v"}}})
    async with asyncio.timeout(5):
        await gate.commit(None, recovery())
    assert gate.state.closed


@pytest.mark.parametrize("noticed", [True, False])
async def test_an_instance_whose_gate_somebody_has_deleted_is_not_fenced_for_its_silence(
    client: MemoryClient, found: ClusterView, tmp_path: Path, noticed: bool
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    progress.open_at = 4
    await client.delete(NETWORK_POLICIES, "fleet", "w-gate")
    new = await client.create(NETWORK_POLICIES, "fleet", GATE.closed("w", Reach(), epoch=4))
    if noticed:
        found.gates.put(new)
    with pytest.raises(NoLongerNeeded, match="somebody deleted the gate"):
        await gate.commit(STANDBY, progress)
    assert (gate.state.closed, gate.state.epoch) == (True, 4)


async def _recreated(client: MemoryClient, found: ClusterView, epoch: int) -> None:
    """Somebody deletes the gate, and the operator creates another one."""
    await client.delete(NETWORK_POLICIES, "fleet", "w-gate")
    found.gates.put(await client.create(NETWORK_POLICIES, "fleet", GATE.closed("w", Reach(), epoch=epoch)))


async def test_a_recovery_is_named_beside_a_gate_that_was_deleted_and_created_again(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    """A monitor that succeeds this one would know neither who failed nor what state is to be given (campaign 59)."""
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    assert not await gate.restore_record(progress), "it has committed nothing yet"
    await gate.commit(None, progress)
    assert not await gate.restore_record(progress), "its record is there"
    await _recreated(client, found, epoch=5)
    progress.strategy = "Restart"
    assert await gate.restore_record(progress)
    restored = gate.state.recovery
    assert restored is not None
    assert (restored.id, restored.epoch, restored.strategy) == (progress.id, 5, "Restart")
    assert (gate.state.closed, gate.state.epoch) == (True, 5), "control does not change"
    assert not await gate.restore_record(progress), "once is enough"
    await gate.commit(STANDBY, progress)
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 6)


async def test_a_recovery_is_not_named_beside_a_gate_of_another_epoch_or_recovery(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    await gate.commit(None, progress)
    assert not await gate.restore_record(recovery()), "another one committed"
    await by_another(client, found, None)
    assert not await gate.restore_record(progress)
    await _recreated(client, found, epoch=9)
    assert not await gate.restore_record(progress)


async def test_a_record_that_could_not_be_restored_is_restored_later(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    progress.waiting = Waiter(workload="w", pool="spare", since=1.0, until=9.0)
    await gate.commit(None, progress)
    await _recreated(client, found, epoch=5)
    client.failing = lambda method, name: TimeoutError() if method == "PATCH" else None
    assert not await gate.restore_record(progress)
    client.failing = lambda method, name: None
    assert await gate.restore_record(progress)
    labels = (await client.get(NETWORK_POLICIES, "fleet", "w-gate"))["metadata"]["labels"]
    assert labels[names.WAITS_FOR] == "spare", "others still see that it waits"


async def test_the_gate_is_not_closed_for_a_leak_that_another_monitor_lets_through(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate = await open_gate(client, found, tmp_path, FAILED)
    over = GateRecord.of(copy.deepcopy(await client.get(NETWORK_POLICIES, "fleet", "w-gate")))
    await GATE.write(
        client, "fleet", "w", GATE.admission("w", over=over, admitted="w-2", admitted_uid="u2", let_through="")
    )
    with pytest.raises(Superseded, match="another process lets w-2 through"):
        await gate.commit(None, None, against={STANDBY.uid})
    assert (gate.state.active, gate.state.admitted) == (FAILED.name, STANDBY.name)


async def test_a_write_that_is_refused_shows_the_gate_although_the_watch_is_half_open(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate = await open_gate(client, found, tmp_path, FAILED)
    await by_another(client, found, STANDBY, noticed=False)
    assert gate.record is not None
    assert not await gate.overtake(gate.record, AbandonedRecovery(id="r", epoch=4, sent=""))
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 5)


async def test_an_instance_that_drives_late_is_not_fenced_before_a_commit_is_answered(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate_control, "RETRY_FIRST", 0.02)
    gate, progress = await open_gate(client, found, tmp_path, FAILED), recovery()
    client.failing = lambda method, name: aiohttp.ClientConnectionError("unreachable") if method == "PATCH" else None
    asyncio.get_running_loop().call_later(0.1, setattr, progress, "drives_late", progress.failed[0])
    with pytest.raises(NoLongerNeeded, match="drives by now"):
        await gate.commit(None, progress)
    assert not gate.state.closed


@pytest.mark.parametrize("drives", ["late", "again"])
async def test_a_commit_without_an_answer_is_known_before_an_instance_that_drives_is_kept(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drives: str
) -> None:
    """Otherwise the recovery ends as if nothing was changed, and is never recorded (seed 3251347)."""
    monkeypatch.setattr(gate_control, "RETRY_FIRST", 0.02)
    gate, progress, running = await open_gate(client, found, tmp_path, FAILED), recovery(), asyncio.get_running_loop()
    write = client.patch

    async def carried_out(*arguments: Any, **options: Any) -> Object:
        await write(*arguments, **options)
        client.failing = lambda method, name: aiohttp.ClientConnectionError("unreachable")
        progress.healthy_again = drives == "again"
        progress.drives_late = progress.failed[0] if drives == "late" else None
        running.call_later(0.2, setattr, client, "failing", lambda method, name: None)
        raise aiohttp.ClientConnectionError("the answer is lost")

    monkeypatch.setattr(client, "patch", carried_out)
    await gate.commit(None, progress)
    assert gate.state.closed


async def test_a_commit_is_superseded_if_somebody_has_just_deleted_the_gate(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    """It must not wait for another gate: its recovery would charge the time to a healthy standby."""
    gate = await open_gate(client, found, tmp_path, FAILED)
    await client.delete(NETWORK_POLICIES, "fleet", "w-gate")
    with pytest.raises(Superseded, match="was deleted"):
        await gate.commit(STANDBY, recovery())


async def test_a_commit_is_tried_again_soon_once_the_api_server_answers_again(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate_control, "RETRY_FIRST", 0.01)
    monkeypatch.setattr(gate_control, "RETRY_MOST", 60.0)
    gate, loop = await open_gate(client, found, tmp_path, FAILED), asyncio.get_running_loop()
    waking = ApiError(403, "Forbidden", "", just_back=True)
    errors: list[Exception] = [
        *[OSError("away")] * 4,
        ApiError(401, "Unauthorized", ""),
        ApiError(503, "Starting", ""),
        waking,
    ]
    asked: list[float] = []

    def answer(method: str, name: str) -> Exception | None:
        if method == "PATCH":
            asked.append(loop.time())
        return errors.pop(0) if method == "PATCH" and errors else None

    client.failing = answer
    await gate.commit(None, recovery())
    assert len(asked) == 8
    assert asked[-1] - asked[-3] < 16 * 0.01, "less than the last pause of the outage"


async def test_a_refused_repair_of_the_gate_is_repeated_once_a_second_or_if_the_gate_changes() -> None:
    objects = ClusterObjects()
    objects.put_gate(GateState(epoch=4, active="w-1", active_uid="u1"))
    view, resource = objects.view, objects.view.gate_kind.resource

    async def edit(app: str) -> None:
        patch = {"spec": {"podSelector": {"matchLabels": {"app": app}}}}
        view.gates.put(await objects.client.patch(resource, view.namespace, objects.gate_name, patch))

    def repairs() -> int:
        return sum(method == "PATCH" for method, _, _ in objects.client.requests)

    await edit("other")
    objects.client.failing = lambda method, name: ApiError(403, "Forbidden", "no") if method == "PATCH" else None
    objects.client.requests.clear()
    for _ in range(50):
        await objects.gate.restore_routing()
    assert repairs() == 1
    objects.client.failing = lambda method, name: None
    await edit("another")
    assert await objects.gate.restore_routing()


async def test_the_epoch_of_a_gate_that_somebody_deleted_is_raised_over_that_which_was_carried_out(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = await open_gate(client, found, tmp_path, FAILED)
    await gate.raise_epoch()
    assert gate.state.epoch == 4
    monkeypatch.setattr(Packets, "carried_out", lambda self, epoch: 6 if epoch <= 6 else 0, raising=False)
    await gate.raise_epoch()
    assert gate.state.epoch == 5, "admission lets a monitor increase the epoch by one only"
    for _ in range(4):
        await gate.raise_epoch()
    assert (gate.state.active, gate.state.epoch) == (FAILED.name, 7)


async def test_the_epoch_of_a_gate_that_somebody_deleted_is_raised_to_that_which_an_agent_knows(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    gate = await open_gate(client, found, tmp_path, FAILED)
    for _ in range(4):
        await gate.raise_epoch(6)
    assert (gate.state.active, gate.state.epoch) == (FAILED.name, 6)


async def test_a_recovery_takes_an_epoch_that_its_own_monitor_raised_for_no_other_process(
    client: MemoryClient, found: ClusterView, tmp_path: Path
) -> None:
    """Nothing of its commit is carried out before the epoch is great enough (seed 3084164)."""
    gate = await open_gate(client, found, tmp_path, FAILED)
    progress = recovery()
    await gate.commit(None, progress)
    await gate.raise_epoch(7)
    assert gate.state.epoch == 6
    await gate.commit(STANDBY, progress)
    assert (gate.state.active, gate.state.epoch) == (STANDBY.name, 7)


async def test_the_epoch_is_not_raised_while_a_commit_is_under_way(
    client: MemoryClient, found: ClusterView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, write, answers = await open_gate(client, found, tmp_path, FAILED), client.patch, asyncio.Event()

    async def slow(*arguments: Any, **more: Any) -> Object:
        await answers.wait()
        return await write(*arguments, **more)

    monkeypatch.setattr(client, "patch", slow)
    committing = asyncio.create_task(gate.commit(None, recovery()))
    await asyncio.sleep(0)
    await gate.raise_epoch(7)
    answers.set()
    assert (await committing).epoch == gate.state.epoch == 5


@pytest.mark.parametrize(
    ("switch", "raised"),
    [
        (OwnSwitch("w-2", is_idle=False, active_sends=True), False),
        (OwnSwitch("w-2", is_idle=True, active_sends=True), True),
        (OwnSwitch("w-9", is_idle=False, active_sends=True), True),
        (OwnSwitch("w-9", is_idle=False, active_sends=False), False),
        (None, False),
    ],
    ids=[
        "it may drive",
        "nothing of it is let through",
        "it is gone",
        "it is gone, and nobody else sends",
        "there is none",
    ],
)
async def test_the_gate_is_of_a_new_epoch_if_the_mux_has_switched_in_vain(
    client: MemoryClient,
    found: ClusterView,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    switch: OwnSwitch | None,
    raised: bool,
) -> None:
    gate = await open_gate(client, found, tmp_path, FAILED)
    monkeypatch.setattr(PodControl, "of_workload", lambda self: [FAILED, replace(STANDBY, running=True)])
    monkeypatch.setattr(Packets, "own_switch", lambda self, active: switch, raising=False)
    await gate.raise_epoch()
    assert (gate.state.active, gate.state.epoch) == (FAILED.name, 5 if raised else 4)
