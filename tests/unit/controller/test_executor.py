from __future__ import annotations

import copy
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.kube.memory import ApplyingClient, MemoryClient
from understudy.api import names
from understudy.controller.plan import Apply, Create, Patch
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.contention import AT_ONCE
from understudy.controller.reconcile.executor import Executor, Stale
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.kube.client import (
    CONFIG_MAPS,
    NETWORK_POLICIES,
    PODS,
    REPLICA_SETS,
    WORKLOADS,
    ApiError,
    Object,
    Resource,
)
from understudy.kube.gates.base import GateRecord, Reach
from understudy.kube.gates.kinds.network_policy import GATE

KEY = Key(WORKLOADS.plural, "fleet", "w")


def config_map(owner: str) -> Object:
    reference = {"apiVersion": "understudy.dev/v1alpha1", "kind": "RobotWorkload", "name": "w", "uid": owner}
    metadata = {"name": "w-robot-env", "namespace": "fleet", "ownerReferences": [{**reference, "controller": True}]}
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata, "data": {}}


def stored(owner: str) -> Object:
    item = copy.deepcopy(config_map(owner))
    item["metadata"] |= {"uid": "earlier", "resourceVersion": "1"}
    return item


def executor(client: MemoryClient, store: Store) -> Executor:
    return Executor(client, store, Expectations(), may_write=lambda: True)


async def test_an_object_of_a_deleted_namespace_does_not_block_a_new_one_with_its_name() -> None:
    # The watch hasn't told yet that it went with its namespace.
    client, store = ApplyingClient(), Store()
    store.put(CONFIG_MAPS, stored("earlier-workload"))
    assert await executor(client, store).run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))]) == []
    made = client.items[(CONFIG_MAPS.plural, "fleet", "w-robot-env")]
    assert made["metadata"]["ownerReferences"][0]["uid"] == "workload"


async def test_an_object_of_another_owner_is_not_changed() -> None:
    client, store = ApplyingClient(), Store()
    client.items[(CONFIG_MAPS.plural, "fleet", "w-robot-env")] = stored("another-workload")
    store.put(CONFIG_MAPS, stored("another-workload"))
    (problem,) = await executor(client, store).run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))])
    assert problem.reason == "NameTaken"
    assert [method for method, _, _ in client.requests] == ["GET"]


async def test_a_repair_of_a_gate_does_not_undo_a_commit_that_came_first() -> None:
    client = MemoryClient()
    gate = client.store(NETWORK_POLICIES, "fleet", GATE.closed("w", Reach(), epoch=3))
    commit = GATE.commitment("w", over=GateRecord.of(gate), active="w-a", active_uid="uid-a")
    await GATE.write(client, "fleet", "w", commit)
    repair = GATE.routing("w", "")
    with pytest.raises(Stale):
        await executor(client, Store()).run(KEY, [Patch(NETWORK_POLICIES, gate, repair)])
    live = await client.get(NETWORK_POLICIES, "fleet", "w-gate")
    assert GATE.let_through(live) == ("w-a",)


async def test_a_template_that_cannot_be_applied_is_reported_and_other_objects_are_still_applied() -> None:
    # As Kubernetes answers to a field that it doesn't know: with 500, as though it might be otherwise the next time.
    words = "failed to create typed patch object (fleet/w; apps/v1, Kind=ReplicaSet): .spec.nodeNane: field not declared in schema"

    class Strict(ApplyingClient):
        async def request(self, method: str, path: str, *, body: Any = None, **more: Any) -> Any:
            if "/replicasets/" in path:
                raise ApiError(500, "Error", words)
            return await super().request(method, path, body=body, **more)

    client = Strict()
    replica_set = {**config_map("workload"), "kind": "ReplicaSet", "metadata": {"name": "w", "namespace": "fleet"}}
    writes = [Apply(REPLICA_SETS, replica_set), Apply(CONFIG_MAPS, config_map("workload"))]
    (problem,) = await executor(client, Store()).run(KEY, writes)
    assert problem.reason == "TemplateInvalid"
    assert ".spec.nodeNane: field not declared" in problem.message
    assert (CONFIG_MAPS.plural, "fleet", "w-robot-env") in client.items


@pytest.mark.parametrize("error", [ApiError(401, "Unauthorized", ""), ApiError(403, "Forbidden", "", just_back=True)])
async def test_a_server_that_has_just_started_does_not_refuse_a_workloads_objects(error: ApiError) -> None:
    client = ApplyingClient()
    client.failing = lambda method, name: error
    with pytest.raises(ApiError):
        await executor(client, Store()).run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))])


async def test_the_executor_remembers_nothing_of_a_deleted_workload() -> None:
    # Else an operator that has seen many come and go needs more and more memory.
    client, store = ApplyingClient(), Store()
    working = executor(client, store)
    for _ in range(2):
        await working.run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))])
        assert working.remembered == {(CONFIG_MAPS.plural, "fleet", "w-robot-env")}
    working.forget(Key(WORKLOADS.plural, "fleet", "another"))
    working.forget(Key(WORKLOADS.plural, "elsewhere", "w"))
    assert working.remembered
    working.forget(KEY)
    assert not working.remembered


def standby(name: str, pool: str) -> Create:
    metadata = {"name": name, "namespace": "fleet", "labels": {names.POOL: pool}}
    return Create(PODS, {"apiVersion": "v1", "kind": "Pod", "metadata": metadata}, counted=True)


async def test_an_exhausted_quota_costs_one_request_per_pool_and_has_a_stable_message() -> None:
    # Words with the names of pods that were never made would be another status each time, and each is looked at again at once.
    client = MemoryClient()
    client.failing = lambda method, name: ApiError(
        403,
        "Forbidden",
        f'pods "{name}" is forbidden: exceeded quota: fleet, requested: pods=1, used: pods=9, limited: pods=9',
    )
    expectations = Expectations()
    tried = Executor(client, Store(), expectations, may_write=lambda: True)
    first = await tried.run(KEY, [standby(f"w-{n}{n}{n}", pool) for pool in ("hot", "warm") for n in range(100)])
    assert len(first) == len(client.requests) == 2
    again = await tried.run(KEY, [standby(f"w-{n}{n}x", pool) for pool in ("hot", "warm") for n in range(100)])
    assert again == first
    assert "exceeded quota: fleet" in first[0].message
    assert expectations.count(KEY, "hot") == 0


class Fought(MemoryClient):
    """Takes server-side apply for a write of the whole object; somebody else changes each back at once."""

    def __init__(self, store: Store, resource: Resource) -> None:
        super().__init__()
        self.store, self.resource, self.applies, self.version = store, resource, 0, 10

    async def request(self, method: str, path: str, *, body: Any = None, **_: Any) -> Any:
        self.applies += 1
        return self._next(copy.deepcopy(body))

    def change_back(self) -> None:
        changed = self._next({**copy.deepcopy(config_map("workload")), "data": {"A": "theirs"}})
        self.store.put(self.resource, changed)

    def _next(self, item: Object) -> Object:
        self.version += 1
        item["metadata"] |= {"uid": "one", "resourceVersion": str(self.version)}
        return item


async def fight(resource: Resource) -> tuple[Fought, list[list[str]]]:
    store = Store()
    client = Fought(store, resource)
    ours = {**config_map("workload"), "data": {"A": "ours"}}
    working, reports = executor(client, store), []
    for _ in range(20):
        client.change_back()
        reports.append([problem.message for problem in await working.run(KEY, [Apply(resource, ours)])])
    return client, reports


async def test_an_object_that_somebody_reverts_each_time_is_reported_and_repaired_less_often() -> None:
    client, reports = await fight(CONFIG_MAPS)
    assert client.applies == 1 + AT_ONCE
    assert reports[: 1 + AT_ONCE] == [[]] * (1 + AT_ONCE)
    (message,) = reports[-1]
    assert_golden("operator", message, "ConfigMap w-robot-env")
    assert "data.A" in message


async def test_a_network_policy_that_somebody_reverts_is_always_repaired_and_reported() -> None:
    client, reports = await fight(NETWORK_POLICIES)
    assert client.applies == 20
    assert "repeatedly" in reports[-1][0]
