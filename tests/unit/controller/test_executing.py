from __future__ import annotations

import copy
from typing import Any

from tests.unit.cluster.memory import MemoryClient
from understudy.api import names
from understudy.cluster.client import CONFIG_MAPS, PODS, REPLICA_SETS, WORKLOADS, ApiError, Object
from understudy.controller.affected import Key
from understudy.controller.desired import Apply, Create
from understudy.controller.executing import Executor
from understudy.controller.expectations import Expectations
from understudy.controller.stores import Store

KEY = Key(WORKLOADS.plural, "fleet", "w")


class Applying(MemoryClient):
    """Takes server-side apply for a write of the whole object."""

    async def request(self, method: str, path: str, *, body: Any = None, **_: Any) -> Any:
        return await self.create(CONFIG_MAPS, "fleet", body)


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


async def test_an_object_of_an_earlier_namespace_of_that_name_stands_in_nobodys_way() -> None:
    # The watch hasn't told yet that it went with its namespace.
    client, store = Applying(), Store()
    store.put(CONFIG_MAPS, stored("earlier-workload"))
    assert await executor(client, store).run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))]) == []
    made = client.items[(CONFIG_MAPS.plural, "fleet", "w-robot-env")]
    assert made["metadata"]["ownerReferences"][0]["uid"] == "workload"


async def test_an_object_that_really_is_somebody_elses_is_left_alone() -> None:
    client, store = Applying(), Store()
    client.items[(CONFIG_MAPS.plural, "fleet", "w-robot-env")] = stored("another-workload")
    store.put(CONFIG_MAPS, stored("another-workload"))
    (problem,) = await executor(client, store).run(KEY, [Apply(CONFIG_MAPS, config_map("workload"))])
    assert problem.reason == "NameTaken"
    assert [method for method, _, _ in client.requests] == ["GET"]


async def test_a_template_that_can_not_be_applied_is_told_and_keeps_nothing_else_from_being_made() -> None:
    # As Kubernetes answers to a field that it doesn't know: with 500, as though it might be otherwise the next time.
    words = "failed to create typed patch object (fleet/w; apps/v1, Kind=ReplicaSet): .spec.nodeNane: field not declared in schema"

    class Strict(Applying):
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


def standby(name: str, pool: str) -> Create:
    metadata = {"name": name, "namespace": "fleet", "labels": {names.POOL: pool}}
    return Create(PODS, {"apiVersion": "v1", "kind": "Pod", "metadata": metadata}, counted=True)


async def test_a_quota_that_is_used_up_is_asked_once_for_each_pool_and_told_in_the_same_words_each_time() -> None:
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
