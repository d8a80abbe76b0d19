"""Collects the input of the pure functions, from the store and, for referred controllers, from the API."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Protocol

from understudy.api import names
from understudy.controller.desired import monitor_deployment, strategy_selection
from understudy.controller.observed import (
    degraded_measures,
    dependency_graph,
    kube_objects,
    leaving_nodes,
    policy_reader,
    pool_reader,
    replacement_standbys,
    workload_reference,
)
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import claim_tokens, pool_evictions, pool_pods
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.policy_maps import PolicyMaps
from understudy.controller.status import workload_status
from understudy.kube import claims, selectors
from understudy.kube.apiserver_addresses import ApiServerAddresses
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    NODES,
    PODS,
    POLICIES,
    POOLS,
    REPLICA_SETS,
    ROLES,
    SECRETS,
    STATEFUL_SETS,
    WORKLOADS,
    Object,
    Resource,
)
from understudy.kube.gates import pool_pod_policies


class Reader(Protocol):
    """Reads objects that are not in the store. :class:`understudy.kube.client.Client` implements it."""

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        """Return an object, or None if it does not exist."""

    async def list(self, resource: Resource, namespace: str | None = None, *, labels: str | None = None) -> Object:
        """Return a collection with its ``items``."""


class Observer:
    """Observes the state around one workload or pool."""

    def __init__(
        self, client: Reader, store: Store, expectations: Expectations, policy_maps: PolicyMaps | None = None
    ) -> None:
        """Without ``policy_maps``, nothing is observed of their room."""
        self._client, self._store, self._expectations = client, store, expectations
        self._policy_maps = policy_maps
        self._apiservers = ApiServerAddresses(client, os.environ)
        self._looked: dict[tuple[str, str], tuple[str, str]] = {}
        """By namespace and name: the UIDs of the pool for which an older Secret was read, and of the Secret found."""

    async def workload(self, item: Object) -> Observed:
        """Return the observed state around a workload."""
        store = self._store
        name, namespace = kube_objects.name(item), item["metadata"]["namespace"]
        found_pools = store.in_namespace(POOLS, namespace)
        key = Key(WORKLOADS.plural, namespace, name)
        uid = kube_objects.uid(item)
        serving = [p for p, pool in found_pools.items() if pool_reader.serves(pool, item)]
        return Observed(
            workload=item,
            now=time.time(),
            policies=store.in_namespace(POLICIES, namespace),
            config_maps=store.in_namespace(CONFIG_MAPS, namespace),
            pools=found_pools,
            held_policies={
                pool: policy
                for pool in serving
                if (policy := store.get(pool_pod_policies.RESOURCE, namespace, names.held(pool))) is not None
            },
            owned=store.owned(uid),
            # Read at the same moment as the next field: a pod that appears during a wait must be in one of the two.
            pods=self._pods(namespace, name, uid),
            expected={pool: self._expected(key, pool) for pool in serving},
            monitors=self._serving(item, "monitor"),
            discovery=self._serving(item, "discovery"),
            unclaimed={
                pool: pool_pods.unclaimed(found_pools[pool], store.labelled(PODS, namespace, names.POOL, pool))
                for pool in serving
            },
            reference=await self._referred(item),
            rivals=self._rivals(item),
            dependencies=self._dependencies(item),
            resized=await self._resized(item),
            cordoned=self._cordoned(),
            leaving=self._leaving(),
            nodes=store.all(NODES),
            budgets=self._budgets(namespace),
            going=frozenset(self._going(namespace, store.get(ROLES, namespace, names.monitor(name)))),
            apiservers=await self._apiservers.read() if _has_reflex(item) else (),
            policy_map=self._policy_maps.low(namespace, name) if self._policy_maps is not None else None,
            policy_map_known=self._policy_maps is not None and self._policy_maps.known,
        )

    def instance(self, workload: Object, pod: Object) -> Observed:
        """Return what is known of one instance of a workload without a request to the API, which may wait."""
        refers = change_index.reference(workload) is not None
        return Observed(
            workload=workload,
            now=time.time(),
            pools=self._store.in_namespace(POOLS, workload["metadata"]["namespace"]),
            pods=[pod],
            reference=workload_reference.ReferencedObjects() if refers else None,
        )

    def _pods(self, namespace: str, workload: str, uid: str) -> list[Object]:
        """Return the pods of a workload: those with its label, and those whose label somebody has removed.

        The latter are known by their owner, or by their spec if their controller has released them.
        """
        labelled = self._store.labelled(PODS, namespace, names.WORKLOAD, workload)
        owned = [item for (plural, _), item in self._store.owned(uid).items() if plural == PODS.plural]
        found = {kube_objects.uid(pod): pod for pod in (*labelled, *owned, *self._store.released(namespace, workload))}
        return list(found.values())

    def _going(self, namespace: str, role: Object | None) -> Iterator[str]:
        """Yield the deleted pools with claimable pods, of those whose agents the monitor may command by its Role."""
        for pool in monitor_deployment.commanded(role):
            pods = self._store.labelled(PODS, namespace, names.POOL, pool)
            if self._store.get(POOLS, namespace, pool) is None and any(map(claim_tokens.claimable, pods)):
                yield pool

    def _budgets(self, namespace: str) -> list[Object]:
        """Return the PodDisruptionBudgets that Understudy did not create."""
        found = self._store.in_namespace(DISRUPTION_BUDGETS, namespace).values()
        return [budget for budget in found if not pool_evictions.is_ours(budget)]

    def _cordoned(self) -> frozenset[str]:
        """Return the nodes that are being drained or are cordoned."""
        return frozenset(kube_objects.name(node) for node in self._store.all(NODES) if leaving_nodes.is_cordoned(node))

    def _leaving(self) -> frozenset[str]:
        """Return the nodes whose pods are about to go."""
        return leaving_nodes.leaving(self._store.all(NODES))

    def _expected(self, key: Key, pool: str) -> int:
        """Return how many pods were requested and have appeared neither in an answer nor in a watch."""
        return self._expectations.count(
            key, pool, observed=lambda name: self._store.get(PODS, key.namespace, name) is not None
        )

    async def _resized(self, item: Object) -> Object | None:
        """Return the active pod to resize, or None.

        It is read from the API, because the store keeps almost nothing of a pod's spec.
        """
        namespace = item["metadata"]["namespace"]
        policy = self._store.get(POLICIES, namespace, change_index.used_policy(item))
        if (
            not degraded_measures.degraded(item)
            or degraded_measures.paused(item)
            or not any(action.resize for action in degraded_measures.actions(policy))
        ):
            return None
        name, uid = kube_objects.active(self._store.gate(item))
        pod = await self._client.find(PODS, namespace, name) if name else None
        return pod if pod is not None and kube_objects.uid(pod) == uid and kube_objects.alive(pod) else None

    def _serving(self, item: Object, component: str) -> list[Object]:
        """Return the pods of a workload's monitor or discovery server."""
        namespace = item["metadata"]["namespace"]
        found = self._store.labelled(PODS, namespace, names.MONITORED, kube_objects.name(item))
        return [pod for pod in found if kube_objects.labels(pod).get(names.COMPONENT) == component]

    def _rivals(self, item: Object) -> list[str]:
        """Return the workloads that referred to the same controller before this one, oldest first."""
        target = change_index.reference(item)
        if target is None:
            return []
        others = self._store.in_namespace(WORKLOADS, item["metadata"]["namespace"]).values()
        older = [
            other
            for other in others
            if change_index.reference(other) == target
            and not kube_objects.deleted(other)
            and kube_objects.sort_key(other) < kube_objects.sort_key(item)
        ]
        return [kube_objects.name(other) for other in sorted(older, key=kube_objects.sort_key)]

    def _dependencies(self, item: Object) -> dict[str, list[str]]:
        """Return the dependencies of each workload of the namespace; empty if this workload has none."""
        if not dependency_graph.named(item):
            return {}
        others = self._store.in_namespace(WORKLOADS, item["metadata"]["namespace"])
        return dependency_graph.graph([*others.values(), item])

    async def _referred(self, item: Object) -> workload_reference.ReferencedObjects | None:
        """Return the referred controller and its pods.

        They are read from the API, because the store does not keep them.
        """
        target = change_index.reference(item)
        if target is None:
            return None
        kind, name = target
        namespace = item["metadata"]["namespace"]
        controller = await self._client.find(DEPLOYMENTS if kind == "Deployment" else STATEFUL_SETS, namespace, name)
        selector = ((controller or {}).get("spec") or {}).get("selector") or {}
        if controller is None or not selectors.requirements(selector):
            return workload_reference.ReferencedObjects(controller)
        text = selectors.as_text(selector)
        pods = (await self._client.list(PODS, namespace, labels=text)).get("items") or []
        sets: list[Object] = []
        if kind == "Deployment":
            sets = (await self._client.list(REPLICA_SETS, namespace, labels=text)).get("items") or []
        return workload_reference.ReferencedObjects(controller, workload_reference.controlled(controller, sets, pods))

    async def pool(self, item: Object) -> pool_pods.Observed:
        """Return the observed state around a pool."""
        store = self._store
        name, namespace = kube_objects.name(item), item["metadata"]["namespace"]
        found = store.in_namespace(WORKLOADS, namespace)
        template, selector = await self._source(item, found)
        secret = await self._token(item)
        gates = [store.gate(workload) for workload in found.values()]
        now = time.time()
        made = store.labelled(PODS, namespace, names.POOL, name)
        active = frozenset(uid for gate in gates if (uid := kube_objects.active(gate)[1]))
        return pool_pods.Observed(
            pool=item,
            workloads=found,
            pods=made,
            owned=store.owned(kube_objects.uid(item)),
            now=now,
            waiting=pool_pods.queue(name, [gate for gate in gates if gate is not None], now),
            source=template,
            source_selector=selector,
            active=active,
            replacement_standbys=self._replacement_standbys(item, found, made, active),
            expected=self._expected(Key(POOLS.plural, namespace, name), name),
            prewarmed=sum(
                pool_reader.serves(item, workload)
                and degraded_measures.prewarmed(
                    workload, store.get(POLICIES, namespace, change_index.used_policy(workload)), name
                )
                for workload in found.values()
            ),
            spared=sum(self._spared(item, workload) for workload in found.values()),
            asking=[workload for workload in found.values() if self._asks(item, workload)],
            leaving=self._leaving(),
            cordoned=self._cordoned(),
            budgets=self._budgets(namespace),
            secret=secret,
        )

    async def _token(self, pool: Object) -> Object | None:
        """Return the Secret for the agents of a pool's pods.

        A Secret that is older than the pool may have been deleted with the previous pool of that name, or with its
        namespace. No watch reports that, and the pool's pods wait for their Secret. So it is read from the API, once.
        """
        place = pool["metadata"]["namespace"], names.pool_secret(kube_objects.name(pool))
        stored = self._store.get(SECRETS, *place)
        if stored is None or kube_objects.created(stored) >= kube_objects.created(pool):
            return stored
        if self._looked.get(place) == (kube_objects.uid(pool), kube_objects.uid(stored)):
            return stored
        live = await self._client.find(SECRETS, *place)
        if live is None:
            self._store.remove(SECRETS, stored)
        else:
            self._store.put(SECRETS, live)
            self._looked[place] = kube_objects.uid(pool), kube_objects.uid(live)
        return self._store.get(SECRETS, *place)

    def _replacement_standbys(
        self, pool: Object, workloads: Mapping[str, Object], pods: Sequence[Object], active: Collection[str]
    ) -> list[Object]:
        """Return the pods of the workloads' own controllers that stand by while one of the pool's pods is active."""
        namespace, found = pool["metadata"]["namespace"], []
        for name in {claims.workload_of(kube_objects.labels(pod)) for pod in pods if kube_objects.uid(pod) in active}:
            workload = workloads.get(name)
            if workload is None or not pool_reader.serves(pool, workload):
                continue
            policy = self._store.get(POLICIES, namespace, change_index.used_policy(workload))
            if replacement_standbys.may_replace(workload, policy):
                gate = self._store.gate(workload)
                its = self._store.labelled(PODS, namespace, names.WORKLOAD, name)
                found += replacement_standbys.of_pool(kube_objects.name(pool), gate, its)
        return found

    def _asks(self, pool: Object, workload: Object) -> bool:
        """Whether a workload claims a pod of a pool when it fails.

        False for a pool whose size does not follow the failure rate.
        """
        if not (pool.get("spec") or {}).get("sizing") or not pool_reader.serves(pool, workload):
            return False
        policy = self._store.get(POLICIES, pool["metadata"]["namespace"], change_index.used_policy(workload))
        if policy is None:
            return False
        if strategy_selection.is_auto(policy):
            return workload_status.takes_from(change_index.chosen(workload), kube_objects.name(pool))
        return kube_objects.name(pool) in policy_reader.named_pools(policy)

    def _spared(self, pool: Object, workload: Object) -> bool:
        """Whether a pool serves this workload but need not hold a standby for it, because other strategies are in force.

        This reads the workload's status, so that strategies are not selected again for every pod of a pool.
        """
        policy = self._store.get(POLICIES, pool["metadata"]["namespace"], change_index.used_policy(workload))
        if policy is None or not strategy_selection.varies(policy) or not pool_reader.serves(pool, workload):
            return False
        chosen = change_index.chosen(workload)
        return bool(chosen) and not workload_status.takes_from(chosen, kube_objects.name(pool))

    async def _source(
        self, item: Object, found: Mapping[str, Object]
    ) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
        source = ((item.get("spec") or {}).get("templateFrom") or {}).get("workload")
        if source is None or source not in found:
            return None, None
        workload = found[source]
        if change_index.reference(workload) is None:
            return (workload.get("spec") or {}).get("template"), None
        referred = await self._referred(workload)
        if referred is None or referred.controller is None:
            return None, None
        spec = referred.controller["spec"]
        return spec["template"], spec["selector"]


def _has_reflex(workload: Object) -> bool:
    """Whether the agents of a workload freeze its instances while nobody answers."""
    return bool(((workload.get("spec") or {}).get("gate") or {}).get("reflex"))
