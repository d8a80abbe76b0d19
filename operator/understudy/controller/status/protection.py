"""What a failure now would lead to: which strategies could be carried out, with what, and else what is missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.robot_workload import STOCKED_MOST
from understudy.controller.desired import effective_policy, standby_pods
from understudy.controller.desired.workload_plan import Understanding
from understudy.controller.observed import degraded_measures, kube_objects, leaving_nodes, pod_diagnosis, pool_reader
from understudy.controller.observed.observation import WAITING, Observed
from understudy.controller.pods import pool_pods, pool_size
from understudy.kube.client import Object

LIMITED = (
    ("Paused", "True", "Paused", "If it failed now, nothing would be done."),
    ("WithinBudget", "False", "BudgetSpent", "If it failed now, it would only be fenced."),
)
"""Conditions of the monitor by which nothing would be recovered, whatever there is to do it with: type, status, the reason that
Protected has then, and what a failure would come to. The monitor tells of them by Events of its own.
"""


@dataclass(frozen=True)
class Means:
    """Whether a strategy could be carried out now."""

    name: str
    available: bool
    reason: str = ""
    message: str = ""


def protected(observed: Observed, understanding: Understanding) -> Condition:
    """Whether a failure now would be met by the policy's first strategy, and else what is missing."""
    generation = kube_objects.generation(observed.workload)
    means = [found for _, found in considered(observed, understanding)]

    def no(reason: str, message: str, outlook: str) -> Condition:
        return condition("Protected", False, reason, f"{message.rstrip('.')}. {outlook}", generation=generation)

    unwatched = "If it failed now, nobody would notice"
    name = kube_objects.name(observed.workload)
    if observed.gate is None:
        lacking = understanding.problem or understanding.policy_problem
        if lacking is not None:
            return no(lacking.reason, lacking.message, f"{unwatched}: nothing was built yet.")
        return no("GateMissing", f"NetworkPolicy {names.gate(name)} is not there", f"{unwatched}: it is being built.")
    if (refused := understanding.policy_problem) is not None:
        return no(refused.reason, refused.message, "What was built before stays as it is.")
    if not any(kube_objects.ready(pod) for pod in observed.monitors):
        found_trouble = pod_diagnosis.first(observed.monitors)
        words = (
            found_trouble.message if found_trouble else f"the monitor (Deployment {names.monitor(name)}) is not ready"
        )
        return no("MonitorNotReady", words, f"{unwatched} until it is.")
    if (limited := _limited(observed)) is not None:
        return no(*limited)
    outlook = _outlook(means)
    if not any(kube_objects.ready(pod) for pod in observed.instances) and (
        found := pod_diagnosis.first(observed.instances)
    ):
        return no(found.reason, found.message, outlook)
    if means and not means[0].available:
        return no(means[0].reason, means[0].message, outlook)
    return condition("Protected", True, "FirstStrategyReady", outlook, generation=generation)


def considered(observed: Observed, understanding: Understanding) -> list[tuple[Strategy, Means]]:
    """The strategies that count now, in the policy's order, each with whether it could be carried out; none while the policy
    can't be followed.
    """
    return [(strategy, _means(observed, understanding, strategy)) for strategy in _strategies(observed, understanding)]


def stocked(observed: Observed, understanding: Understanding) -> Object:
    """The shared pools that it could claim from, the first ones of an order that was chosen among many. Its monitor goes by this until it
    needs a pod, and asks only then.
    """
    shared = [p for p in observed.pools if pool_reader.readiness(observed.pools[p]) == "Uninitialized"]
    found = [
        strategy.pool_ref.name
        for strategy in _strategies(observed, understanding)
        if strategy.pool_ref is not None and strategy.pool_ref.name in shared
        if _means(observed, understanding, strategy).available
    ]
    return {"stocked": found[:STOCKED_MOST]} if found else {}


def standby(observed: Observed, understanding: Understanding) -> str:
    """The printed column: readiness of its policy's first pool that serves it, and how many of how many are ready."""
    served = observed.serving
    for strategy in _strategies(observed, understanding):
        name = strategy.pool_ref.name if strategy.pool_ref else ""
        if name not in served:
            continue
        pool = served[name]
        if pool_reader.readiness(pool) in WAITING:
            want = standby_pods.wanted(observed, name)
            have = sum(kube_objects.ready(pod) for pod in waiting(observed, pool))
            return f"{pool_reader.readiness(pool)} ({min(have, want)}/{want})"
        if pool_reader.readiness(pool) == "Uninitialized":
            # Of a shared pool one counts, which is all that it could claim: a number that changes with each claim of any
            # other workload would be written as often to all of them.
            want = min(1, pool_size.size(pool))
            held = observed.unclaimed.get(name, ())
            have = len(pool_pods.claimable_now(held, observed.held_policies.get(name)))
            return f"Uninitialized ({min(have, want)}/{want})"
    if understanding.policy_problem is not None or understanding.spec is None:
        known: str = (observed.workload.get("status") or {}).get("standby") or "Unknown"
        return known
    return "None"


def waiting(observed: Observed, pool: Object) -> list[Object]:
    """The instances that could take over from the active one: all but it that have an agent, whoever made them.

    What a referred controller makes has none.
    """
    active = kube_objects.active(observed.gate)[1]
    if active and standby_pods.own_stands_by(observed):
        # Where there are standbys of several readinesses, each counts for its own pool.
        others = {name for name in observed.standby_pools if name != kube_objects.name(pool)}
        found = [pod for pod in observed.instances if kube_objects.uid(pod) != active]
        return [pod for pod in found if kube_objects.labels(pod).get(names.POOL) not in others]
    made = [pod for pod in observed.instances if kube_objects.labels(pod).get(names.POOL) == kube_objects.name(pool)]
    return [pod for pod in made if kube_objects.uid(pod) != active]


def _limited(observed: Observed) -> tuple[str, str, str] | None:
    """Why nothing would be recovered now although it could be, by what the monitor says: reason, message and outlook."""
    said = (observed.workload.get("status") or {}).get("conditions") or []
    for type_, status_, reason, outlook in LIMITED:
        found = next((c for c in said if (c["type"], c["status"]) == (type_, status_)), None)
        if found is not None:
            return reason, found.get("message", ""), outlook
    return None


def _outlook(means: Sequence[Means]) -> str:
    available = next((m for m in means if m.available), None)
    if available is None:
        return "If it failed now, no strategy of its policy could be carried out."
    told = f": {available.message}" if available.message else ""
    return f"If it failed now, {available.name} would be used{told}."


def _strategies(observed: Observed, understanding: Understanding) -> list[Strategy]:
    if understanding.spec is None or understanding.policy_problem is not None:
        return []
    policy = observed.policies[understanding.spec.failure_policy_ref.name]
    found = effective_policy.strategies(observed)
    on_demand = degraded_measures.prewarms(policy)
    awake = [s for s in found if s.pool_ref is None or not _asleep(observed, s.pool_ref.name, on_demand)]
    return awake or found


def _asleep(observed: Observed, name: str, on_demand: Sequence[str]) -> bool:
    """Whether a pool is one that has standbys only while a workload is degraded, and has none now: nobody counts on it."""
    pool = observed.pools.get(name)
    if name not in on_demand or pool is None or pool_reader.readiness(pool) not in WAITING:
        return False
    if not pool_reader.serves(pool, observed.workload):
        return False  # which is told
    if pool["spec"].get("perWorkload"):
        return False
    return not standby_pods.wanted(observed, name) or not any(kube_objects.ready(pod) for pod in _made(observed, name))


def _made(observed: Observed, pool: str) -> list[Object]:
    """The standbys that a pool has made for the workload."""
    found = [pod for pod in observed.instances if kube_objects.labels(pod).get(names.POOL) == pool]
    return [pod for pod in found if not kube_objects.is_active(pod, observed.gate)]


def _means(observed: Observed, understanding: Understanding, strategy: Strategy) -> Means:
    unfound = _discovery_missing(observed, understanding)
    if strategy.type == "Restart" or strategy.pool_ref is None:
        return unfound("Restart") or _restart(observed)
    name = strategy.pool_ref.name
    pool = observed.pools.get(name)
    label = f"Fallback from pool {name}"
    if pool is None or kube_objects.deleted(pool):
        words = (
            f'FallbackPool "{name}", which its policy names, is not there ({kube_objects.hint(name, observed.pools)})'
        )
        return Means(label, False, "NoPool", f"{words}. Create it, or correct the policy")
    if not pool_reader.serves(pool, observed.workload):
        return Means(
            label,
            False,
            "PoolDoesNotServe",
            f"FallbackPool {name} doesn't serve it: its workloadSelector doesn't match the labels of this "
            f"RobotWorkload. Put them on its metadata, or correct the selector",
        )
    match pool_reader.readiness(pool):
        case "Executing" | "Initialized":
            found = _standing(observed, label, pool)
            return found if found.available else unfound(label) or found
        case "Uninitialized":
            priority = understanding.spec.pool_priority if understanding.spec is not None else 0
            return unfound(label) or _uninitialized(observed, label, pool, priority)
    return Means(label, False, "PoolNotAccepted", f"FallbackPool {name} was not accepted: kubectl describe fbp {name}")


def _discovery_missing(observed: Observed, understanding: Understanding) -> Callable[[str], Means | None]:
    """Whether what would have to start now couldn't find its robot; what runs already has found it."""
    spec = understanding.spec
    lacking = (
        spec is not None
        and spec.ros.discovery.mode == "Managed"
        and not any(kube_objects.ready(pod) for pod in observed.discovery)
    )

    def means(strategy: str) -> Means | None:
        if not lacking:
            return None
        server = names.discovery(kube_objects.name(observed.workload))
        found = pod_diagnosis.first(observed.discovery)
        words = f": {found.message}" if found else ""
        told = f"the ROS discovery server (Deployment {server}) is not ready, so nothing that starts finds the robot"
        return Means(strategy, False, "DiscoveryNotReady", f"{told}{words}")

    return means


def _restart(observed: Observed) -> Means:
    own = [p for p in observed.instances if names.POOL not in kube_objects.labels(p) and kube_objects.alive(p)]
    found = pod_diagnosis.first(own)
    if found is not None and not any(kube_objects.ready(pod) for pod in own):
        return Means("Restart", False, found.reason, found.message)
    return Means("Restart", True)


def _standing(observed: Observed, label: str, pool: Object) -> Means:
    name = kube_objects.name(pool)
    if not standby_pods.wanted(observed, name):
        return Means(label, False, "PoolEmpty", f"FallbackPool {name} has spec.perWorkload 0")
    found = waiting(observed, pool)
    ready = [pod for pod in found if kube_objects.ready(pod)]
    if ready:
        near = ", on the same node as the pod in control" if _beside_active(observed, ready) else ""
        return Means(label, True, message=f"pod {kube_objects.name(ready[0])} ({pool_reader.readiness(pool)}){near}")
    if (refused := observed.refused(name)) is not None:
        words = f"FallbackPool {name} is not accepted, so no standby is made: {refused.message}"
        return Means(label, False, "PoolNotAccepted", words)
    if bad := pod_diagnosis.first(found):
        return Means(label, False, bad.reason, bad.message)
    return Means(label, False, "StandbyNotReady", f"no standby of FallbackPool {name} is ready (see BroughtUp)")


def _beside_active(observed: Observed, found: Sequence[Object]) -> bool:
    """Whether all of these would be lost with the node of the pod in control."""
    active = kube_objects.active(observed.gate)[1]
    its = next((leaving_nodes.of(pod) for pod in observed.instances if kube_objects.uid(pod) == active), "")
    return its != "" and all(leaving_nodes.of(pod) == its for pod in found)


def _uninitialized(observed: Observed, label: str, pool: Object, priority: int) -> Means:
    name = kube_objects.name(pool)
    held = observed.unclaimed.get(name, ())
    ready = pool_pods.claimable_now(held, observed.held_policies.get(name))
    kept = pool_reader.spec(pool).kept_from(priority) if observed.refused(name) is None else 0
    if len(ready) > kept:
        # How many it has is in its own status: here each claim would be a write for every workload that it serves.
        return Means(label, True, message="it has pods ready (Uninitialized)")
    if ready:
        words = (
            f"FallbackPool {name} keeps its last {kept} for workloads with a higher spec.poolPriority (spec.reserve)"
        )
        return Means(label, False, "PodsReserved", f"{words}, and has no more ready")
    if not pool_size.size(pool):
        field = "spec.sizing.min" if pool["spec"].get("sizing") else "spec.replicas"
        return Means(label, False, "PoolEmpty", f"FallbackPool {name} has {field} 0")
    if bad := pod_diagnosis.first(held):
        return Means(label, False, bad.reason, bad.message)
    return Means(label, False, "StandbyNotReady", f"no pod of FallbackPool {name} is ready")
