"""Finds the objects that must be reconciled again after an observed change."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.desired import strategy_selection
from understudy.controller.observed import (
    committed_recovery,
    dependency_graph,
    health_tree_sources,
    kube_objects,
    leaving_nodes,
    ownership,
    policy_reader,
    replacement_standbys,
)
from understudy.controller.pods import pool_pods
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.status import storm_detection
from understudy.kube import claims
from understudy.kube.apply import controller_of, released
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    NETWORK_POLICIES,
    NODES,
    PODS,
    POLICIES,
    POOLS,
    SECRETS,
    STATEFUL_SETS,
    WORKLOADS,
    Object,
    Resource,
)
from understudy.kube.gates import pool_pod_policies, registry


class Key(NamedTuple):
    """One object of the three kinds, or an instance whose labels are restored."""

    plural: str
    namespace: str
    name: str


_PLURALS = {"RobotWorkload": WORKLOADS.plural, "FallbackPool": POOLS.plural}


_RESTORED = (names.COMPONENT, names.WORKLOAD, names.INSTANCE, names.POOL, names.CLAIMED_BY)
"""Labels of an instance that are restored: by the first three, the policies of the gate select."""


class Affected(NamedTuple):
    """The effect of a change."""

    keys: set[Key]
    """Objects that the change may affect. Extra keys do no harm."""
    is_claim: bool
    """Whether a workload has claimed one of many pods of a shared pool, or names it in the policy of such pods.

    Until the workload's gate reports the result, the claim does not affect other objects.
    """


def of(change: ObservedChange, store: Store) -> Affected:
    """Return the effect of a change. The store already contains the change."""
    plenty = _plenty(change, store)
    return Affected(set(_keys(change, store, plenty)), _is_claim(change, plenty))


def tampered(change: ObservedChange) -> Key | None:
    """Return the key of an instance of which somebody changed a label that is restored; None for any other change.

    The pod has a key of its own, because it may be behind no policy until the label is restored. The reconciliation of its workload may
    take longer: for a webhook that does not answer, that is ten seconds.
    """
    old, new = change.old, change.new
    if change.resource.plural != PODS.plural or old is None or new is None or kube_objects.deleted(new):
        return None
    before, after = kube_objects.labels(old), kube_objects.labels(new)
    if kube_objects.uid(old) != kube_objects.uid(new) or all(
        before.get(k) in (None, names.UNCLAIMED, after.get(k)) for k in _RESTORED
    ):
        return None
    return Key(PODS.plural, new["metadata"]["namespace"], kube_objects.name(new)) if workload_of(new) else None


def workload_of(pod: Object) -> str:
    """Return the workload whose instance a pod is by its owner or, for a pod of a ReplicaSet, by its label; empty if there is none."""
    owner = controller_of(pod)
    if owner is not None and ownership.is_understudys(pod):
        return owner["name"] if owner["kind"] == "RobotWorkload" else ""
    if workload := released(pod):
        return workload
    labels = kube_objects.labels(pod)
    return labels.get(names.WORKLOAD, "") if labels.get(names.SOURCE) == "workload" else ""


def _keys(change: ObservedChange, store: Store, plenty: Collection[str]) -> Iterator[Key]:
    found = change.new or change.old
    assert found is not None
    namespace = found["metadata"].get("namespace", "")
    plural = change.resource.plural
    if plural == NODES.plural:
        yield from _after_node(change, store)
        return
    if plural == DISRUPTION_BUDGETS.plural:
        yield from _after_budget(change, store, namespace)
        return
    for item in (change.old, change.new):
        owner = controller_of(item) if item is not None else None
        if owner is not None and owner.get("apiVersion") == API_VERSION and owner.get("kind") in _PLURALS:
            yield Key(_PLURALS[owner["kind"]], namespace, owner["name"])
    if plural in (WORKLOADS.plural, POLICIES.plural, POOLS.plural):
        yield Key(plural, namespace, kube_objects.name(found))
        if _spec_changed(change):
            yield from _after_spec(change, store, namespace)
        elif plural == WORKLOADS.plural:
            if _differs(change, chosen):
                for name in store.in_namespace(POOLS, namespace):  # the number of its standbys in each pool
                    yield Key(POOLS.plural, namespace, name)
            elif _recoveries_changed(change):
                yield from _sized(store, namespace)
            yield from _after_health(change, store, namespace)
    elif plural == PODS.plural:
        yield from _after_pod(change, store, namespace, plenty)
    elif change.resource in registry.FENCING_RESOURCES:
        yield from _after_policy(found, store, namespace)
        yield from _after_commit(change, store, namespace)
    elif plural == CONFIG_MAPS.plural:
        yield from _after_trees(found, store, namespace)
    elif plural == SECRETS.plural and (pool := kube_objects.labels(found).get(names.POOL)):
        yield Key(POOLS.plural, namespace, pool)


def _is_claim(change: ObservedChange, plenty: Collection[str]) -> bool:
    if change.old is None or change.new is None:
        return False
    if change.resource.plural == NETWORK_POLICIES.plural:
        return _is_of_claimed_pods(change.new)
    if change.resource.plural != PODS.plural:
        return False
    before = kube_objects.labels(change.old)
    return (
        claims.is_held(before)
        and names.CLAIM in kube_objects.notes(change.new)
        and before.get(names.POOL, "") in plenty
    )


def _is_of_claimed_pods(policy: Object) -> bool:
    owner = controller_of(policy)
    return owner is not None and kube_objects.name(policy) == names.claimed(owner["name"])


def _spec_changed(change: ObservedChange) -> bool:
    if change.old is None or change.new is None:
        return True
    old, new = change.old["metadata"], change.new["metadata"]
    return any(old.get(key) != new.get(key) for key in ("uid", "generation", "labels", "deletionTimestamp"))


def _differs(change: ObservedChange, part: Callable[[Object], object]) -> bool:
    """Whether an object existed before and after a change, and a part of it is different now."""
    return change.old is not None and change.new is not None and part(change.old) != part(change.new)


def _recoveries_changed(change: ObservedChange) -> bool:
    counts = [((item or {}).get("status") or {}).get("recoveryCount") for item in (change.old, change.new)]
    return counts[0] != counts[1]


def _sized(store: Store, namespace: str) -> Iterator[Key]:
    """Yield the pools whose size follows the failure rate."""
    for name, pool in store.in_namespace(POOLS, namespace).items():
        if (pool.get("spec") or {}).get("sizing"):
            yield Key(POOLS.plural, namespace, name)


def _dependencies_changed(change: ObservedChange) -> bool:
    """Whether a workload was created or deleted, or its dependencies have changed."""
    if change.old is None or change.new is None or kube_objects.deleted(change.old) != kube_objects.deleted(change.new):
        return True
    return dependency_graph.named(change.old) != dependency_graph.named(change.new)


def _after_health(change: ObservedChange, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the policy that counts how many of its workloads fail at the same time."""
    if change.new is not None and _differs(change, storm_detection.health):
        yield from _guard(change.new, store, namespace)


def _after_commit(change: ObservedChange, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the workload's policy if a recovery begins. The gate shows that before the workload's status does."""
    if change.new is None or not _differs(change, committed_recovery.beside):
        return
    owner = controller_of(change.new)
    workload = store.get(WORKLOADS, namespace, owner["name"]) if owner is not None else None
    if workload is not None:
        yield from _guard(workload, store, namespace)


def _guard(workload: Object, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the workload's policy if it has a storm guard."""
    policy = store.get(POLICIES, namespace, used_policy(workload))
    if policy is not None and policy_reader.storm_guard(policy) is not None:
        yield Key(POLICIES.plural, namespace, kube_objects.name(policy))


def _after_spec(change: ObservedChange, store: Store, namespace: str) -> Iterator[Key]:
    found = change.new or change.old
    assert found is not None
    if change.resource.plural == WORKLOADS.plural:
        for item in (change.old, change.new):
            if item is not None and (policy := used_policy(item)):
                yield Key(POLICIES.plural, namespace, policy)
        for name in store.in_namespace(POOLS, namespace):
            yield Key(POOLS.plural, namespace, name)
        dependencies_changed = _dependencies_changed(change)
        for name, other in store.in_namespace(WORKLOADS, namespace).items():
            rival = reference(other) and reference(other) == reference(found)
            if rival or (
                dependencies_changed and dependency_graph.named(other)
            ):  # it may depend on this one, or be in a cycle with it
                yield Key(WORKLOADS.plural, namespace, name)
    elif change.resource.plural == POLICIES.plural:
        yield from users(kube_objects.name(found), store, namespace)
        yield from _sized(store, namespace)  # the workloads that claim from them may have changed
    else:
        for name in store.in_namespace(POLICIES, namespace):
            yield Key(POLICIES.plural, namespace, name)
        for name in store.in_namespace(WORKLOADS, namespace):
            yield Key(WORKLOADS.plural, namespace, name)


def _after_pod(change: ObservedChange, store: Store, namespace: str, plenty: Collection[str]) -> Iterator[Key]:
    for item in (change.old, change.new):
        if item is None:
            continue
        labels = kube_objects.labels(item)
        workloads = (claims.workload_of(labels), labels.get(names.MONITORED))
        yield from (Key(WORKLOADS.plural, namespace, name) for name in workloads if name)
        if pool := labels.get(names.POOL):
            yield Key(POOLS.plural, namespace, pool)
        # Somebody may have removed the labels.
        if ownership.is_understudys(item) and (owner := controller_of(item)) is not None:
            yield Key(_PLURALS[owner["kind"]], namespace, owner["name"])
        elif workload := released(item):
            yield Key(WORKLOADS.plural, namespace, workload)
        if labels.get(names.SOURCE) == "workload":
            yield from _stood_in_for(labels.get(names.WORKLOAD, ""), store, namespace)
        if claims.is_held(labels) and labels.get(names.POOL, "") not in plenty:
            yield from _pool_users(labels.get(names.POOL, ""), store, namespace)


def _stood_in_for(workload: str, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the pool whose pod is active while a pod of the workload's own controller stands by for it."""
    item = store.get(WORKLOADS, namespace, workload)
    gate = store.gate(item) if item is not None else None
    if not kube_objects.active(gate)[1]:
        return
    pool = replacement_standbys.displaced(gate, store.labelled(PODS, namespace, names.WORKLOAD, workload))
    if pool:
        yield Key(POOLS.plural, namespace, pool)


def _plenty(change: ObservedChange, store: Store) -> Collection[str]:
    """Return the shared pools that hold or held this pod and have enough other claimable pods."""
    if change.resource.plural != PODS.plural:
        return ()
    known = [
        item for item in (change.old, change.new) if item is not None and claims.is_held(kube_objects.labels(item))
    ]
    # The pool before and after the change is usually the same one, so this asks once per pool.
    held = {kube_objects.labels(item).get(names.POOL, ""): item for item in known}
    return [pool for pool, item in held.items() if _has_plenty(pool, item, store, item["metadata"]["namespace"])]


def _has_plenty(name: str, held: Object, store: Store, namespace: str) -> bool:
    """Whether a shared pool has enough other claimable pods that this one makes no difference to any workload.

    Without this check, each claim and each step of a starting pod would reconcile every workload of a fleet.
    """
    pool = store.get(POOLS, namespace, name)
    if pool is None:
        return False
    reserved = ((pool.get("spec") or {}).get("reserve") or {}).get("pods") or 0
    allowed = pool_pods.claimable_hash(store.get(pool_pod_policies.RESOURCE, namespace, names.held(name)))
    others = (
        pod
        for pod in store.labelled(PODS, namespace, names.POOL, name)
        if kube_objects.uid(pod) != kube_objects.uid(held)
    )
    # A fleet's pool has hundreds of pods, and each step of each of them comes here. So the count stops early.
    found = itertools.islice((pod for pod in others if pool_pods.is_claimable(pod, allowed)), reserved + 1)
    return sum(1 for _ in found) > reserved


def _after_policy(policy: Object, store: Store, namespace: str) -> Iterator[Key]:
    owner = controller_of(policy)
    if _is_of_claimed_pods(policy):
        return
    if owner is not None and owner["kind"] == "FallbackPool":
        yield from _pool_users(owner["name"], store, namespace)
    elif owner is not None and owner["kind"] == "RobotWorkload":
        for name in store.in_namespace(POOLS, namespace):  # the active pods of each pool may have changed
            yield Key(POOLS.plural, namespace, name)


def _going(node: Object) -> tuple[bool, bool]:
    return leaving_nodes.is_cordoned(node), leaving_nodes.is_leaving(node)


def _after_node(change: ObservedChange, store: Store) -> Iterator[Key]:
    """Yield the owners of pods that are about to leave a node.

    Nodes report all the time. A change matters only if it changes which nodes are cordoned or being drained.
    """
    known = [item for item in (change.old, change.new) if item is not None]
    if len(known) == 2 and _going(known[0]) == _going(known[1]):
        return
    # This includes pods on other nodes: a node to move to may have appeared or disappeared.
    places = {kube_objects.name(node) for node in (*known, *store.all(NODES)) if leaving_nodes.is_leaving(node)}
    for pod in store.all(PODS):
        if leaving_nodes.of(pod) not in places:
            continue
        labels, namespace = kube_objects.labels(pod), pod["metadata"]["namespace"]
        for plural, name in ((WORKLOADS, claims.workload_of(labels)), (POOLS, labels.get(names.POOL))):
            if name:
                yield Key(plural.plural, namespace, name)
        if labels.get(names.SOURCE) == "workload":
            yield from _stood_in_for(labels.get(names.WORKLOAD, ""), store, namespace)
    # A node that is added accepts no pods at first. When the operator starts, each node of the cluster is added.
    if change.old is not None and change.new is not None and not leaving_nodes.is_leaving(change.new):
        yield from _sharing_a_node(store)


def _sharing_a_node(store: Store) -> Iterator[Key]:
    """Yield the workloads with several pods on one node: another node may have room for a standby or the monitor now."""
    found: set[tuple[str, str, str]] = set()
    for pod in store.all(PODS):
        labels, place = kube_objects.labels(pod), leaving_nodes.of(pod)
        workload = claims.workload_of(labels) or labels.get(names.MONITORED)
        if workload and place:
            namespace = pod["metadata"]["namespace"]
            if (namespace, workload, place) in found:
                yield Key(WORKLOADS.plural, namespace, workload)
            found.add((namespace, workload, place))


def _after_budget(change: ObservedChange, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the owner of a PodDisruptionBudget of Understudy, or all workloads and pools for any other budget.

    Another budget may select any instance, and the waiting pods of any pool.
    """
    if not _spec_changed(change):  # its status changes with every pod
        return
    owner = controller_of(change.new or change.old or {"metadata": {}})
    if owner is not None and owner.get("apiVersion") == API_VERSION:
        yield Key(_PLURALS[owner["kind"]], namespace, owner["name"])
        return
    for plural in (WORKLOADS, POOLS):
        for name in store.in_namespace(plural, namespace):
            yield Key(plural.plural, namespace, name)


def _after_trees(config_map: Object, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the policies whose health tree is in a ConfigMap, and the workloads that they protect."""
    for name, policy in store.in_namespace(POLICIES, namespace).items():
        if health_tree_sources.reference(policy) == kube_objects.name(config_map):
            yield Key(POLICIES.plural, namespace, name)
            yield from users(name, store, namespace)


def _pool_users(pool: str, store: Store, namespace: str) -> Iterator[Key]:
    for name, policy in store.in_namespace(POLICIES, namespace).items():
        if strategy_selection.is_auto(policy) or pool in policy_reader.named_pools(policy):
            yield from users(name, store, namespace)


def users(policy: str, store: Store, namespace: str) -> Iterator[Key]:
    """Yield the workloads that a policy protects."""
    for name, workload in store.in_namespace(WORKLOADS, namespace).items():
        if used_policy(workload) == policy:
            yield Key(WORKLOADS.plural, namespace, name)


def used_policy(workload: Object) -> str:
    """Return the name of the policy that a workload refers to, or an empty string."""
    found: str = ((workload.get("spec") or {}).get("failurePolicyRef") or {}).get("name", "")
    return found


def chosen(workload: Object) -> str:
    """Return the strategies in force from a workload's status, in short form; empty if it does not have them yet."""
    found: str = (workload.get("status") or {}).get("strategies") or ""
    return found


def reference(workload: Object) -> tuple[str, str] | None:
    """Return kind and name of the controller that a workload refers to, or None."""
    found: dict[str, Any] | None = (workload.get("spec") or {}).get("workloadRef")
    return (found["kind"], found["name"]) if found else None


def referring(resource: Resource, item: Object, store: Store) -> set[Key]:
    """Return the keys that depend on a referred controller, or on the controller of a pod that is not labelled yet.

    A Deployment's pod is recognized by the name of its ReplicaSet. A mistake costs one reconciliation and no more.
    """
    target: tuple[str, str] | None = None
    if resource.plural == DEPLOYMENTS.plural:
        target = ("Deployment", kube_objects.name(item))
    elif resource.plural == STATEFUL_SETS.plural:
        target = ("StatefulSet", kube_objects.name(item))
    elif resource.plural == PODS.plural and (owner := controller_of(item)) is not None:
        if owner["kind"] == "ReplicaSet":
            hashed = kube_objects.labels(item).get("pod-template-hash", "")
            target = ("Deployment", owner["name"].removesuffix(f"-{hashed}"))
        elif owner["kind"] == "StatefulSet":
            target = ("StatefulSet", owner["name"])
    if target is None:
        return set()
    namespace = item["metadata"].get("namespace", "")
    found = {
        Key(WORKLOADS.plural, namespace, name)
        for name, workload in store.in_namespace(WORKLOADS, namespace).items()
        if reference(workload) == target
    }
    if resource.plural != PODS.plural:
        found |= {pool for workload in found for pool in _copying(workload, store)}
    return found


def _copying(workload: Key, store: Store) -> Iterator[Key]:
    """Yield the pools that take their template from a workload."""
    for name, pool in store.in_namespace(POOLS, workload.namespace).items():
        if ((pool.get("spec") or {}).get("templateFrom") or {}).get("workload") == workload.name:
            yield Key(POOLS.plural, workload.namespace, name)


def unlisted(store: Store) -> Iterator[Key]:
    """Yield the objects that depend on referred controllers.

    The operator does not list such controllers, so it reconciles these objects after every list.
    """
    for workload in store.all(WORKLOADS):
        if reference(workload) is not None:
            key = Key(WORKLOADS.plural, workload["metadata"]["namespace"], kube_objects.name(workload))
            yield key
            yield from _copying(key, store)
