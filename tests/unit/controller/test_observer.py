"""What is seen around an object fits together, also where something is waited for in between."""

from __future__ import annotations

from typing import Any, cast

from tests.unit.controller.world import hot, pod, standby_pod, workload
from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.kube.client import PODS, POOLS, WORKLOADS, Client


async def test_a_standby_that_appears_while_a_deployment_is_read_counts_once() -> None:
    store, expectations = Store(), Expectations()
    item = workload("w", workloadRef={"kind": "Deployment", "name": "nav2"})
    for resource, found in ((WORKLOADS, item), (POOLS, hot())):
        store.put(resource, found)
    expectations.expect(Key(WORKLOADS.plural, "fleet", "w"), "hot", "w-1")

    class Slow:
        """While it answers, a watch brings the pod whose creation got no answer."""

        async def find(self, *_: Any) -> None:
            store.put(PODS, standby_pod("w-1", of=item))

    observed = await Observer(cast(Client, Slow()), store, expectations).workload(item)
    assert len(observed.pods) + observed.expected["hot"] == 1
    again = await Observer(cast(Client, Slow()), store, expectations).workload(item)
    assert (len(again.pods), again.expected["hot"]) == (1, 0)


async def test_a_standby_without_its_label_is_still_observed_by_its_owner() -> None:
    store, item = Store(), workload("w")
    store.put(WORKLOADS, item)
    standby = standby_pod("w-1", of=item)
    del standby["metadata"]["labels"][names.WORKLOAD]
    store.put(PODS, standby)
    observed = await Observer(cast(Client, None), store, Expectations()).workload(item)
    assert [kube_objects.name(pod) for pod in observed.pods] == ["w-1"]


async def test_a_pod_that_its_controller_released_is_observed_once() -> None:
    store, item = Store(), workload("w")
    store.put(WORKLOADS, item)
    agent = {"name": names.AGENT_CONTAINER, "env": [{"name": names.WORKLOAD_VARIABLE, "value": "w"}]}
    for name, labels in (("w-a", {}), ("w-b", {names.WORKLOAD: "w"})):
        store.put(PODS, pod(name, labels=labels) | {"spec": {"containers": [agent]}})
    observed = await Observer(cast(Client, None), store, Expectations()).workload(item)
    assert sorted(kube_objects.name(one) for one in observed.pods) == ["w-a", "w-b"]
