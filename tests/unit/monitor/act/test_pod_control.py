"""Pods as instances: what a kubelet and a node's loss say of them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import replace
from typing import Any

import pytest

from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects, pod_of
from understudy.api import names
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.kube import watched_collection
from understudy.kube.client import NETWORK_POLICIES, PODS, REPLICA_SETS, ApiError, Object
from understudy.kube.gates import pool_pod_policies
from understudy.monitor.act.objects import pod_control
from understudy.monitor.act.objects.pod_control import instance_of

EVICTION = {"type": "DisruptionTarget", "status": "True", "reason": "DeletionByTaintManager"}
DELETED = {"deletionTimestamp": "2026-01-01T00:00:30Z"}


def pod(metadata: dict[str, Any] | None = None, **status: Any) -> dict[str, Any]:
    containers = [{"name": "drive"}, {"name": names.AGENT_CONTAINER}]
    return {
        "metadata": {"name": "w-1", "uid": "uid-1", **(metadata or {})},
        "spec": {"containers": containers},
        "status": {"phase": "Running", **status},
    }


def container(name: str, reason: str, restarts: int = 3) -> dict[str, Any]:
    return {"name": name, "restartCount": restarts, "state": {"waiting": {"reason": reason}}}


@pytest.mark.parametrize(
    ("status", "crashing"),
    [
        (container("drive", "CrashLoopBackOff"), True),
        (container("drive", "ContainerCreating"), False),
        (container(names.AGENT_CONTAINER, "CrashLoopBackOff"), False),
    ],
)
def test_a_crash_loop_is_recognized_from_the_container_status(status: dict[str, Any], crashing: bool) -> None:
    found = instance_of(pod(containerStatuses=[status]))
    assert found.crashing is crashing
    assert found.usable


def test_a_pod_that_is_evicted_from_a_lost_node_is_not_leaving() -> None:
    found = instance_of(pod(DELETED, conditions=[EVICTION]))
    assert (found.terminating, found.evicted, found.leaving, found.usable) == (True, True, False, False)


@pytest.mark.parametrize("conditions", [[], [{**EVICTION, "reason": "EvictionByEvictionAPI"}]])
def test_a_pod_that_is_deleted_for_another_reason_is_leaving(conditions: list[dict[str, Any]]) -> None:
    found = instance_of(pod(DELETED, conditions=conditions))
    assert (found.terminating, found.evicted, found.leaving) == (True, False, True)


@pytest.mark.parametrize(
    "instance",
    [
        Instance("w-1", "u1", ip="10.0.0.1", running=True, ready=True, node="n", created="2026-01-01T00:00:00Z"),
        Instance("s-1", "u2", pool="spare", held=True, claim="u/1", template_hash="h", has_agent=False),
        Instance("w-2", "u3", running=True, terminating=True, evicted=True, restarts=2, crashing=True),
        Instance("w-3", "u4", running=True, agent_protocol=1),
        Instance("w-4", "u5", running=True, agent_port=20002),
    ],
)
def test_the_pods_of_the_tests_represent_their_instances(instance: Instance) -> None:
    assert instance_of(pod_of(instance)) == instance


@pytest.mark.parametrize(
    ("environment", "protocol"),
    [
        (None, 1),
        ([], 1),
        ([{"name": names.POD_UID_VARIABLE, "valueFrom": {}}], 1),
        ([{"name": names.AGENT_PROTOCOL_VARIABLE, "value": "2"}], 2),
        ([{"name": names.AGENT_PROTOCOL_VARIABLE, "value": "3"}], 2),
        ([{"name": names.AGENT_PROTOCOL_VARIABLE, "value": "two"}], 2),
        ([{"name": names.AGENT_PROTOCOL_VARIABLE}], 1),
    ],
)
def test_the_protocol_of_an_agent_is_that_of_its_pods_spec(environment: Any, protocol: int) -> None:
    """Not one of a label or an annotation, which others may change."""
    found = pod({"labels": {names.AGENT_PROTOCOL_VARIABLE: "1"}})
    if environment is not None:
        found["spec"]["containers"][1]["env"] = environment
    assert instance_of(found).agent_protocol == protocol


OWNED = {"ownerReferences": [{"kind": "RobotWorkload", "name": "w", "uid": "u", "controller": True}]}


def test_a_claimed_pod_is_of_its_pool_although_somebody_has_removed_the_label() -> None:
    """Else its ReplicaSet would be scaled to zero instead of deleting it, and no token would fit its agent."""
    claimed = pod(OWNED | {"annotations": {names.CLAIM: "u/1"}})
    claimed["spec"]["volumes"] = [
        {"name": "tmp", "emptyDir": {}},
        {"name": names.TOKEN_VOLUME, "secret": {"secretName": names.pool_secret("spare")}},
    ]
    found = instance_of(claimed)
    assert (found.pool, found.from_source) == ("spare", False)


@pytest.mark.parametrize(
    ("owners", "secret"),
    [
        ({"ownerReferences": [{"kind": "ReplicaSet", "name": "w", "controller": True}]}, names.agent_secret("w")),
        ({"ownerReferences": [{"kind": "ReplicaSet", "name": "w", "controller": True}]}, names.pool_secret("w")),
        ({}, names.pool_secret("w")),
    ],
)
def test_a_pod_of_the_workloads_own_controller_stays_one_although_somebody_wrote_a_claim(
    owners: Any, secret: str
) -> None:
    """Else a restart would wait in vain for another one. A workload "w-pool" has a Secret with the name of a pool's."""
    found = pod(owners | {"annotations": {names.CLAIM: "a/b"}})
    found["spec"]["volumes"] = [{"name": names.TOKEN_VOLUME, "secret": {"secretName": secret}}]
    assert (instance_of(found).pool, instance_of(found).from_source) == ("", True)


def test_a_standby_without_its_label_is_not_of_the_workloads_own_controller() -> None:
    assert not instance_of(pod(OWNED)).from_source
    assert instance_of(pod({"ownerReferences": [{"kind": "ReplicaSet", "name": "w", "controller": True}]})).from_source


def test_a_pod_that_is_not_deleted_is_neither_evicted_nor_leaving() -> None:
    found = instance_of(pod(conditions=[EVICTION]))
    assert (found.terminating, found.evicted, found.leaving) == (False, False, False)


def test_conditions_and_restarts_are_read_without_those_of_the_agent() -> None:
    ready = {"type": "Ready", "status": "False", "reason": "ContainersNotReady"}
    found = instance_of(
        pod(
            conditions=[ready, {"type": "PodScheduled", "status": "True"}],
            containerStatuses=[
                container("drive", "", 2),
                container("arm", "", 1),
                container(names.AGENT_CONTAINER, "", 9),
            ],
        )
    )
    assert found.conditions == (("Ready", "False", "ContainersNotReady"), ("PodScheduled", "True", ""))
    assert found.restarts == 3


FAILED = Instance("w-1", "u1", running=True)


def objects(*errors: Exception) -> ClusterObjects:
    """A pod and its ReplicaSet, which runs none. The first requests fail by these errors."""
    found, left = ClusterObjects(), list(errors)
    found.put_settings()
    found.put_pods(FAILED)
    found.client.store(REPLICA_SETS, NAMESPACE, {"metadata": {"name": "w"}, "spec": {"replicas": 0}})
    found.client.failing = lambda method, name: left.pop() if left else None
    return found


@pytest.mark.parametrize(
    "error",
    [ApiError(429, "TooManyRequests", "later"), ApiError(500, "Error", "etcd"), OSError("reset"), TimeoutError()],
)
async def test_a_pod_is_replaced_despite_temporary_errors_of_the_api_server(error: Exception) -> None:
    found = objects(error, error)
    await found.pods.replace([FAILED])
    scaled = [body["spec"]["replicas"] for method, name, body in found.client.requests if method == "PATCH"]
    assert (scaled, found.deleted) == ([1, 1, 1], ["w-1"])
    assert found.client.items[REPLICA_SETS.plural, NAMESPACE, "w"]["spec"] == {"replicas": 1}
    assert found.client.requests[-1][0] == "DELETE", "there is room for another one before"


async def test_a_pod_that_may_not_be_replaced_is_not_requested_again() -> None:
    found = objects(ApiError(403, "Forbidden", "no"))
    with pytest.raises(ApiError, match="Forbidden"):
        await found.pods.replace([FAILED])
    assert len(found.client.requests) == 1
    assert found.client.items[REPLICA_SETS.plural, NAMESPACE, "w"]["spec"] == {"replicas": 0}


async def test_a_refused_list_of_a_pool_is_a_strategy_that_is_not_available() -> None:
    found = objects(ApiError(403, "Forbidden", "no"))
    with pytest.raises(NotAvailable, match="FallbackPool spare: 403 Forbidden"):
        await found.pods.refresh_unclaimed("spare", part=True)


CLAIMED = ("networkpolicies", NAMESPACE, "w-claimed")


def with_a_pool(*, policy: bool = True) -> ClusterObjects:
    """A workload with one unclaimed pod of a shared pool, of which a list was read."""
    found = ClusterObjects()
    found.put_settings(pools=[{"name": "spare", "readiness": "Uninitialized", "template_hash": ""}])
    free = pod_of(Instance("spare-1", "u1", pool="spare", held=True, running=True, ready=True))
    found.view.unclaimed("spare").items["spare-1"] = found.client.store(PODS, NAMESPACE, free)
    if policy:
        found.client.store(NETWORK_POLICIES, NAMESPACE, pool_pod_policies.claimed_pods("w", {"egress": [{}]}, []))
    return found


async def test_a_claimed_pod_is_named_in_the_policy_of_claimed_pods() -> None:
    found = with_a_pool()
    earlier = pod_of(Instance("spare-0", "u0", pool="spare", held=True, running=True))
    earlier["metadata"]["labels"][names.CLAIMED_BY] = "w"
    found.view.put(found.client.store(PODS, NAMESPACE, earlier))
    (free,) = found.pods.unclaimed("spare")
    await found.pods.claim(free, "uid-w/1")
    assert found.client.items[CLAIMED]["spec"] == {
        "podSelector": pool_pod_policies.claimed_selector("w", ["spare-0", "spare-1"]),
        "egress": [{}],
    }


async def test_a_claim_changes_no_label_by_which_a_policy_selects() -> None:
    """Cilium applies no change of a policy to a pod while it waits for the identity of the new labels: for up to 35 s."""
    found = with_a_pool()
    (free,) = found.pods.unclaimed("spare")
    place = (PODS.plural, NAMESPACE, free.name)
    before = dict(found.client.items[place]["metadata"]["labels"])
    claimed = await found.pods.claim(free, "uid-w/1")
    after = found.client.items[place]["metadata"]["labels"]
    assert after == before | {names.CLAIMED_BY: "w"}
    assert names.CLAIMED_BY.startswith("annotation.")
    assert [one.uid for one in found.pods.of_workload()] == [claimed.uid]
    assert not found.pods.unclaimed("spare") or found.pods.unclaimed("spare")[0].claim == ""


@pytest.mark.parametrize("status", [403, 404, 503])
async def test_a_pod_is_claimed_although_it_cannot_be_named_in_that_policy(status: int) -> None:
    """Such as by an operator of an earlier version, which makes no such policy."""
    found = with_a_pool(policy=status != 404)
    refused = ApiError(status, "Refused", "no")
    found.client.failing = lambda method, name: refused if name == "w-claimed" and status != 404 else None
    (free,) = found.pods.unclaimed("spare")
    claimed = await found.pods.claim(free, "uid-w/1")
    assert (claimed.claim, claimed.held) == ("uid-w/1", False)


async def test_an_api_server_that_does_not_answer_a_list_is_asked_for_something_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pod_control, "LIST_WITHIN", 0.01)
    found = objects()
    monkeypatch.setattr(found.client, "table", lambda *_, **__: asyncio.sleep(60))
    listing = asyncio.create_task(found.pods.refresh_unclaimed("spare"))
    async with asyncio.timeout(5):
        while ("GET", names.gate("w"), None) not in found.client.requests:
            await asyncio.sleep(0.005)
    assert not listing.done()
    listing.cancel()


@contextlib.asynccontextmanager
async def half_open(found: ClusterObjects, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    """Have the pods listed, and then a watch that reports nothing."""

    async def silent(*_: object, **__: object) -> AsyncIterator[tuple[str, Object]]:
        await asyncio.Event().wait()
        yield "", {}

    monkeypatch.setattr(found.client, "watch", silent)
    monkeypatch.setattr(watched_collection, "LATE", 0.05)
    running = asyncio.create_task(found.view.pods.run())
    try:
        await found.view.pods.synced.wait()
        yield
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


@pytest.mark.parametrize("successor", [None, "u9"], ids=["gone", "another pod"])
@pytest.mark.parametrize(
    "ask",
    [lambda pods: pods.end(FAILED), lambda pods: pods.label(FAILED), lambda pods: pods.look_at(FAILED)],
    ids=["delete", "label", "read"],
)
async def test_pods_are_listed_again_after_a_request_about_one_that_is_gone_without_a_report_of_the_watch(
    ask: Callable[[pod_control.PodControl], Coroutine[Any, Any, None]],
    successor: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = objects()
    unlabelled = pod_of(FAILED)
    del unlabelled["metadata"]["labels"][names.INSTANCE]  # there is something to write
    found.client.store(PODS, NAMESPACE, unlabelled)
    async with half_open(found, monkeypatch):
        del found.client.items[PODS.plural, NAMESPACE, "w-1"]
        if successor is not None:
            found.client.store(PODS, NAMESPACE, pod_of(Instance("w-1", successor, running=True)))
        assert [i.uid for i in found.pods.of_workload()] == ["u1"]
        with contextlib.suppress(ApiError):
            await ask(found.pods)
        async with asyncio.timeout(5):
            while found.pods.find("u1") is not None:
                await asyncio.sleep(0.01)
        assert [i.uid for i in found.pods.of_workload()] == ([successor] if successor else [])


async def test_a_pod_that_is_looked_at_is_leaving_although_its_watch_reports_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = objects()
    async with half_open(found, monkeypatch):
        leaving = pod_of(replace(FAILED, terminating=True))
        found.client.store(PODS, NAMESPACE, leaving)
        await found.pods.look_at(FAILED)
        known = found.pods.find("u1")
        assert known is not None
        assert known.leaving


@pytest.mark.parametrize("error", [ApiError(500, "Error", "etcd"), TimeoutError()])
async def test_a_pod_that_cannot_be_looked_at_stays_as_it_is_known(error: Exception) -> None:
    found = objects(error)
    await found.pods.look_at(FAILED)
    assert found.pods.find("u1") == FAILED


async def test_pods_are_listed_again_after_a_deletion_that_the_watch_does_not_report(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = objects()
    async with half_open(found, monkeypatch):
        await found.pods.end(FAILED)
        found.client.store(PODS, NAMESPACE, pod_of(Instance("w-2", "u2", running=True)))
        async with asyncio.timeout(5):
            while [i.uid for i in found.pods.of_workload()] != ["u2"]:
                await asyncio.sleep(0.01)
