"""Builds the observed state of a workload as the operator does, from the objects that kubectl returns."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.controller.observed import health_tree_sources, situation_strategies
from understudy.controller.observed.observation import Observed
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer, Reader
from understudy.kube.client import CONFIG_MAPS, PODS, POLICIES, POOLS, WORKLOADS, Object, Resource
from understudy.kube.gates import registry

_KINDS = {
    "RobotWorkload": WORKLOADS,
    "FailurePolicy": POLICIES,
    "FallbackPool": POOLS,
    "Pod": PODS,
    "ConfigMap": CONFIG_MAPS,
    **registry.OBJECT_KINDS,
}


@dataclass(frozen=True)
class WorkloadObjects:
    """A workload with the objects around it."""

    observed: Observed
    events: Sequence[Object]
    """The Events about it."""
    workloads: Sequence[Object] = ()
    """The workloads of its namespace."""
    gates: Mapping[str, Object] = field(default_factory=dict)
    """The NetworkPolicies and other objects of the namespace that keep instances from robots, by name. The gate objects
    are among them."""


def around(kubectl: Kubectl, name: str) -> WorkloadObjects:
    """Read the observed state around a workload. Raises CommandError."""
    item = kubectl.get(WORKLOADS.qualified, name)
    kinds = (POLICIES, POOLS, WORKLOADS, PODS, *registry.FENCING_RESOURCES)
    items = kubectl.get(",".join(kind.qualified for kind in kinds))["items"]
    policy = change_index.used_policy(item)
    used = [i for i in items if i["kind"] == "FailurePolicy" and i["metadata"]["name"] == policy]
    if any(situation_strategies.has_some(i) for i in used):
        # Which policy is effective depends on the one before, which the monitor received in this ConfigMap.
        config_map = kubectl.find(CONFIG_MAPS.qualified, names.settings(name))
        items += [config_map] if config_map is not None else []
    if any(health_tree_sources.reference(i) for i in used):
        items += kubectl.get(CONFIG_MAPS.qualified, "-l", f"{names.HEALTH_TREE}=true")["items"]
    selector = f"involvedObject.kind=RobotWorkload,involvedObject.name={name}"
    events = kubectl.get("events", "--field-selector", selector)["items"]
    others = [one for one in items if one["kind"] == "RobotWorkload"]
    gates = {one["metadata"]["name"]: one for one in items if one["kind"] in registry.OBJECT_KINDS}
    return WorkloadObjects(observed_from(item, items, KubectlReader(kubectl)), events, others, gates)


def observed_from(item: Object, items: Iterable[Object], reader: Reader) -> Observed:
    """Build the observed state from the objects of the namespace; ``reader`` fetches those that are not among them."""
    store = Store()
    for found in items:
        store.put(_KINDS[found["kind"]], found)
    return asyncio.run(Observer(reader, store, Expectations()).workload(item))


class KubectlReader:
    """Fetches objects with kubectl, which knows the namespace."""

    def __init__(self, kubectl: Kubectl) -> None:
        self._kubectl = kubectl

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        """Return an object, or None if it does not exist."""
        found: Object | None = self._kubectl.find(resource.qualified, name)
        return found

    async def list(self, resource: Resource, namespace: str | None = None, *, labels: str | None = None) -> Object:
        """Return a collection: its objects are in ``items``."""
        found: Object = self._kubectl.get(resource.qualified, *(["-l", labels] if labels else []))
        return found
