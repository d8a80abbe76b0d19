"""Waiting for a pod of a dry pool, between monitors: what one says beside its gate is what the others and people read."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import ClusterObjects, pod_of, policy_of, settings_of
from tests.unit.monitor.gates import gate
from tests.unit.monitor.pool_views import view
from understudy.api import names
from understudy.failover.interfaces import Instance
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import Progress
from understudy.failover.strategies.registry import choices
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.kube.client import NETWORK_POLICIES, PODS, ApiError, Object
from understudy.monitor.act.recovery.pool_waiting import PoolQueue
from understudy.monitor.act.recovery.recovery_messages import describe

NOW = time.time()


def place(workload: str, *, pool: str = "spare", priority: int = 0) -> Waiter:
    return Waiter(workload=workload, pool=pool, priority=priority, since=NOW, until=NOW + 60)


def waits(me: Waiter) -> Progress:
    progress = Progress.begin("no /cmd_vel for 500 ms", last_healthy=NOW - 1, detected=NOW)
    progress.waiting = me
    return progress


async def test_the_gate_records_the_pool_for_which_its_workload_waits(tmp_path: Path) -> None:
    client = MemoryClient()
    found = view(client, "w")
    switch = await gate(client, found, tmp_path)
    progress = waits(place("w"))
    await switch.commit(None, progress)
    stored = await client.get(NETWORK_POLICIES, "fleet", "w-gate")
    assert stored["metadata"]["labels"][names.WAITS_FOR] == "spare"
    assert switch.state.closed
    assert switch.state.recovery is not None
    assert switch.state.recovery.waiting == progress.waiting
    progress.waiting = None
    await switch.commit(None, progress)
    stored = await client.get(NETWORK_POLICIES, "fleet", "w-gate")
    assert stored["metadata"]["labels"] == {"app": "w"}
    assert switch.state.epoch == 6


async def test_admitting_an_instance_ends_the_wait(tmp_path: Path) -> None:
    client = MemoryClient()
    switch = await gate(client, view(client, "w"), tmp_path)
    await switch.commit(None, waits(place("w")))
    await switch.commit(Instance(name="w-2", uid="u2"), None)
    stored = await client.get(NETWORK_POLICIES, "fleet", "w-gate")
    assert names.WAITS_FOR not in stored["metadata"]["labels"]


@pytest.mark.parametrize(
    "error",
    [ApiError(429, "TooManyRequests", "later"), ApiError(500, "Error", "etcd"), OSError("reset"), TimeoutError()],
)
async def test_a_pod_is_admitted_despite_temporary_errors_at_its_labels(tmp_path: Path, error: Exception) -> None:
    client, refusals = MemoryClient(), [error, error]
    found, instance = view(client, "w"), Instance(name="w-2", uid="u2")
    switch = await gate(client, found, tmp_path)
    unlabelled = pod_of(instance)
    unlabelled["metadata"]["labels"] = {}
    found.pods.put(client.store(PODS, "fleet", unlabelled))
    client.failing = lambda method, name: refusals.pop() if name == "w-2" and refusals else None
    await switch.commit(instance, None)
    assert switch.state.active == "w-2"
    assert client.items[PODS.plural, "fleet", "w-2"]["metadata"]["labels"][names.INSTANCE] == "w-2"


def noted(gate_name: str, waiter: Waiter, **annotations: str) -> Object:
    recovery = {names.RECOVERY: waits(waiter).model_dump_json()} | annotations
    metadata = {
        "name": gate_name,
        "resourceVersion": "5",
        "labels": {names.WAITS_FOR: waiter.pool},
        "annotations": recovery,
    }
    return {"metadata": metadata}


async def test_the_queue_contains_workloads_that_wait_for_the_same_pool_at_their_own_gates() -> None:
    found = view(MemoryClient(), "w")
    for item in (
        noted("w-gate", place("w")),
        noted("a-gate", place("a", priority=7)),
        noted("b-gate", place("b", pool="other")),
        noted("c-gate", place("a", priority=1000)),  # nobody speaks for another
        noted("d-gate", place("d"), **{names.RECOVERY: "{"}),
    ):
        found.waiting_gates[0].put(item)
    line = PoolQueue(found, RecordedNotices())
    assert [(w.workload, w.priority) for w in line.others("spare")] == [("a", 7)]


async def test_the_place_in_the_queue_is_reported_in_the_condition_and_in_one_event() -> None:
    notices, me = RecordedNotices(), place("w", priority=5)
    line = PoolQueue(view(MemoryClient(), "w"), notices)
    notices.condition("Recovering", "True", "FailureDetected", "no /cmd_vel for 500 ms")
    line.waits(me, 1, 3)
    condition = notices.status.find("Recovering")
    assert condition is not None
    assert (condition.status, condition.reason) == ("True", "WaitingForPod")
    assert condition.message.startswith("no /cmd_vel for 500 ms; the workload has waited for a pod of ")
    assert_golden(
        "monitor",
        re.sub(r"\d\d:\d\d:\d\d", "TIME", condition.message),
        "FallbackPool spare",
        "position 2 of 3",
        "poolPriority 5",
    )
    line.waits(me, 0, 2)
    assert "position 1 of 2" in notices.conditions["Recovering"][2]
    assert [(kind, reason) for kind, reason, _ in notices.events] == [("Warning", "WaitingForPod")]
    line.served(me, "spare-x")
    condition = notices.status.find("Recovering")
    assert condition is not None
    assert (condition.status, condition.reason) == ("True", "FailureDetected")
    assert condition.message.startswith("no /cmd_vel for 500 ms; claimed spare-x after ")
    line.waits(me, 0, 1)
    assert "; claimed" in notices.conditions["Recovering"][2], "a second wait of the same recovery goes on from there"
    line.gave_up(me)
    assert "got no pod of FallbackPool spare in " in notices.conditions["Recovering"][2]
    assert len(notices.events) == 2


def test_a_recovery_reports_how_long_it_waited() -> None:
    progress = waits(place("w"))
    progress.result, progress.strategy = "Recovered", "Fallback/Uninitialized"
    assert "waited" not in describe(progress.to_recovery(1))
    progress.moments |= {"queued": NOW, "claimed": NOW + 2.14}
    assert describe(progress.to_recovery(1)).endswith(", including 2.1 s of waiting for a pod")


def test_a_strategy_has_the_wait_of_the_policy_and_the_priority_of_the_workload() -> None:
    waiting = {"type": "Fallback", "poolRef": {"name": "spare"}}
    policy = policy_of({**waiting, "waitFor": "2.5s"}, waiting)
    settings = settings_of(pools=[{"name": "spare", "readiness": "Uninitialized", "reserved": 2}])
    found = [choice.strategy for choice in choices(policy, settings, None)]
    assert [(one.wait_for, one.reserved) for one in found if isinstance(one, UninitializedFallback)] == [
        (2.5, 2),
        (0.0, 2),
    ]
    objects = ClusterObjects()
    queue = PoolQueue(objects.view, objects.notices)
    for spec, priority in (({}, 0), ({"poolPriority": 100}, 100)):
        objects.put_workload(**spec)
        assert queue.priority == priority
