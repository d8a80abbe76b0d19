"""Determines what would happen at a failure now: which strategies could run, with which pods, and what the others lack.

This module describes the objects around a workload as ``failover.availability.Resources``, and the limits that its
monitor reports as ``failover.decide.Facts``. Those modules then decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.robot_workload import STOCKED_MOST
from understudy.controller.desired import effective_policy, standby_pods
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import degraded_measures, kube_objects, leaving_nodes, pod_diagnosis, pool_reader
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import pool_pods, pool_size
from understudy.failover import availability
from understudy.failover.availability import Availability, Pool, Problem, Resources
from understudy.failover.decide import Facts, Occurrence, Trigger, in_force
from understudy.failover.limits.state import ActiveLimit, LimitsInForce
from understudy.kube.client import Object

LIMIT_CONDITIONS = {"Paused": "Paused", "WithinBudget": "BudgetSpent"}
"""The monitor's conditions for limits, with the reason of Protected while each limit is in force.

The monitor reports these conditions with its own Events.
"""

_FAILURE = Occurrence(Trigger.HEALTH_FAILED)


@dataclass(frozen=True)
class StrategyAvailability:
    """A strategy of the policy, and whether it could run now."""

    strategy: Strategy
    name: str
    """The strategy's name in messages."""
    availability: Availability


def protected(observed: Observed, workload_plan: WorkloadPlan) -> Condition:
    """Return the condition Protected.

    It reports whether the policy's first strategy could run at a failure now, and what is missing if not.
    """

    def no(reason: str, message: str, consequence: str) -> Condition:
        return condition("Protected", False, reason, f"{message.rstrip('.')}. {consequence}")

    unwatched = "a failure is not detected"
    name = kube_objects.name(observed.workload)
    if observed.gate is None:
        problem = workload_plan.problem or workload_plan.policy_problem
        if problem is not None:
            return no(problem.reason, problem.message, f"Nothing was created yet, so {unwatched}.")
        return no(
            "GateMissing",
            f"the gate {names.gate(name)} does not exist",
            f"Until the operator has created it, {unwatched}.",
        )
    if (refused := workload_plan.policy_problem) is not None:
        return no(
            refused.reason, refused.message, "The operator leaves the objects that it created before as they are."
        )
    if not any(kube_objects.ready(pod) for pod in observed.monitors):
        trouble = pod_diagnosis.first(observed.monitors)
        words = trouble.message if trouble else f"the monitor (Deployment {names.monitor(name)}) is not ready"
        return no("MonitorNotReady", words, f"Until the monitor is ready, {unwatched}.")
    for prevention in in_force(Facts(observed.now, limits=reported_limits(observed)), _FAILURE):
        if not prevention.row.protected:
            return no(
                prevention.decision.reason, prevention.limit.words, f"If it failed now, {prevention.row.consequence}."
            )
    found = considered(observed, workload_plan)
    consequence = _consequence(found)
    if not any(kube_objects.ready(pod) for pod in observed.instances) and (
        trouble := pod_diagnosis.first(observed.instances)
    ):
        return no(trouble.reason, trouble.message, consequence)
    if found and not found[0].availability.available:
        return no(found[0].availability.reason, found[0].availability.message, consequence)
    return condition("Protected", True, "FirstStrategyReady", consequence)


def reported_limits(observed: Observed) -> LimitsInForce:
    """Return the limits that clear Protected, as the monitor reports them in its conditions."""
    reported = {
        (one["type"], one["status"]): ActiveLimit(one.get("message", ""))
        for one in (observed.workload.get("status") or {}).get("conditions") or []
    }
    return LimitsInForce(pause=reported.get(("Paused", "True")), budget=reported.get(("WithinBudget", "False")))


def considered(observed: Observed, workload_plan: WorkloadPlan) -> list[StrategyAvailability]:
    """Return the strategies that count now, in the policy's order; empty while the policy is missing or invalid."""
    there, found = resources(observed, workload_plan), []
    for strategy in _strategies(observed, workload_plan):
        if strategy.pool_ref is None:
            found.append(StrategyAvailability(strategy, strategy.type, availability.restart(there)))
        else:
            name = strategy.pool_ref.name
            found.append(
                StrategyAvailability(strategy, f"Fallback from pool {name}", availability.fallback(name, there))
            )
    return found


def resources(observed: Observed, workload_plan: WorkloadPlan) -> Resources:
    """Return the resources that a workload's strategies need, from the objects around it."""
    named = {s.pool_ref.name for s in _strategies(observed, workload_plan) if s.pool_ref is not None}
    pools = {name: item for name, item in observed.pools.items() if name in named and not kube_objects.deleted(item)}
    return Resources(
        pools={name: _pool(observed, workload_plan, item) for name, item in pools.items()},
        discovery=_discovery(observed, workload_plan),
        restart=_restart(observed),
        hints={name: kube_objects.hint(name, observed.pools) for name in named - set(pools)},
    )


def stocked(observed: Observed, workload_plan: WorkloadPlan) -> Object:
    """Return the status field with the shared pools from which a pod could be claimed, in order, at most ``STOCKED_MOST``.

    The monitor relies on it until it needs a pod, and reads the pool only then.
    """
    shared = [p for p in observed.pools if pool_reader.is_shared(observed.pools[p])]
    found = [
        one.strategy.pool_ref.name
        for one in considered(observed, workload_plan)
        if one.strategy.pool_ref is not None and one.strategy.pool_ref.name in shared and one.availability.available
    ]
    return {"stocked": found[:STOCKED_MOST]} if found else {}


def standby(observed: Observed, workload_plan: WorkloadPlan) -> str:
    """Return the printed column Standby.

    It has the readiness of the first pool that serves the workload, and its numbers of ready and wanted instances.
    """
    served = observed.serving
    for strategy in _strategies(observed, workload_plan):
        name = strategy.pool_ref.name if strategy.pool_ref else ""
        if name not in served:
            continue
        pool = served[name]
        if pool_reader.has_standbys(pool):
            want = standby_pods.wanted(observed, name)
            have = sum(kube_objects.ready(pod) for pod in waiting(observed, pool))
            return f"{pool_reader.readiness(pool)} ({min(have, want)}/{want})"
        if pool_reader.is_shared(pool):
            # Only one pod of a shared pool counts, because a workload can claim only one. The number of pods changes
            # with each claim of any workload, and would be written to all of them each time.
            want = min(1, pool_size.size(pool))
            held = observed.unclaimed.get(name, ())
            have = len(pool_pods.claimable_now(held, observed.held_policies.get(name)))
            return f"{pool_reader.readiness(pool)} ({min(have, want)}/{want})"
    if workload_plan.policy_problem is not None or workload_plan.spec is None:
        known: str = (observed.workload.get("status") or {}).get("standby") or "Unknown"
        return known
    return "None"


def waiting(observed: Observed, pool: Object) -> list[Object]:
    """Return the instances with an agent that could take over from the active one.

    Pods of a controller that the workload only refers to have no agent.
    """
    active = kube_objects.active(observed.gate)[1]
    if active and standby_pods.own_pod_may_replace(observed):
        # With standbys of several readiness levels, each counts for its own pool.
        others = {name for name in observed.standby_pools if name != kube_objects.name(pool)}
        found = [pod for pod in observed.instances if kube_objects.uid(pod) != active]
        return [pod for pod in found if kube_objects.labels(pod).get(names.POOL) not in others]
    made = [pod for pod in observed.instances if kube_objects.labels(pod).get(names.POOL) == kube_objects.name(pool)]
    return [pod for pod in made if kube_objects.uid(pod) != active]


def _consequence(found: Sequence[StrategyAvailability]) -> str:
    first = next((one for one in found if one.availability.available), None)
    if first is None:
        return "If it failed now, no strategy of its policy could run."
    details = f": {first.availability.message}" if first.availability.message else ""
    return f"If it failed now, {first.name} would be used{details}."


def _strategies(observed: Observed, workload_plan: WorkloadPlan) -> list[Strategy]:
    if workload_plan.spec is None or workload_plan.policy_problem is not None:
        return []
    policy = observed.policies[workload_plan.spec.failure_policy_ref.name]
    found = effective_policy.strategies(observed)
    on_demand = degraded_measures.prewarms(policy)
    awake = [s for s in found if s.pool_ref is None or not _asleep(observed, s.pool_ref.name, on_demand)]
    return awake or found


def _asleep(observed: Observed, name: str, on_demand: Sequence[str]) -> bool:
    """Return whether a pool has standbys only while the workload is degraded, and has none now."""
    pool = observed.pools.get(name)
    if name not in on_demand or pool is None or not pool_reader.has_standbys(pool):
        return False
    if not pool_reader.serves(pool, observed.workload):
        return False  # reported as PoolDoesNotServe
    if pool["spec"].get("perWorkload"):
        return False
    return not standby_pods.wanted(observed, name) or not any(kube_objects.ready(pod) for pod in _made(observed, name))


def _made(observed: Observed, pool: str) -> list[Object]:
    """Return the standbys that a pool created for the workload."""
    found = [pod for pod in observed.instances if kube_objects.labels(pod).get(names.POOL) == pool]
    return [pod for pod in found if not kube_objects.is_active(pod, observed.gate)]


def _pool(observed: Observed, workload_plan: WorkloadPlan, item: Object) -> Pool:
    """Return what a workload could use from a pool."""
    readiness, serves = pool_reader.readiness(item), pool_reader.serves(item, observed.workload)
    name = kube_objects.name(item)
    if pool_reader.has_standbys(item):
        found = waiting(observed, item)
        ready = [pod for pod in found if kube_objects.ready(pod)]
        near = ", on the same node as the active pod" if ready and _beside_active(observed, ready) else ""
        refused = observed.refused(name)
        return Pool(
            readiness=readiness,
            serves=serves,
            wanted=standby_pods.wanted(observed, name),
            ready=len(ready),
            uses=f"pod {kube_objects.name(ready[0])} ({readiness}){near}" if ready else "",
            refused=Problem(refused.reason, refused.message) if refused is not None else None,
            pod_problem=_problem(found),
        )
    if pool_reader.is_shared(item):
        unclaimed = observed.unclaimed.get(name, ())
        priority = workload_plan.spec.pool_priority if workload_plan.spec is not None else 0
        return Pool(
            readiness=readiness,
            serves=serves,
            wanted=pool_size.size(item),
            size_field="spec.sizing.min" if item["spec"].get("sizing") else "spec.replicas",
            ready=len(pool_pods.claimable_now(unclaimed, observed.held_policies.get(name))),
            reserved=pool_reader.spec(item).kept_from(priority) if observed.refused(name) is None else 0,
            # The number of pods is in the pool's own status. Here, each claim would cause a write for every workload of
            # the pool.
            uses=f"it has pods ready ({readiness})",
            pod_problem=_problem(unclaimed),
        )
    return Pool(serves=serves)


def _problem(pods: Sequence[Object]) -> Problem | None:
    found = pod_diagnosis.first(pods)
    return Problem(found.reason, found.message) if found is not None else None


def _discovery(observed: Observed, workload_plan: WorkloadPlan) -> Problem | None:
    """Return why an instance that starts now could not find its robot. A running instance has found it already."""
    spec = workload_plan.spec
    if spec is None or spec.ros.discovery.mode != "Managed" or any(map(kube_objects.ready, observed.discovery)):
        return None
    server = names.discovery(kube_objects.name(observed.workload))
    found = pod_diagnosis.first(observed.discovery)
    details = f": {found.message}" if found else ""
    text = f"the ROS discovery server (Deployment {server}) is not ready, so new processes cannot join the robot's ROS graph{details}"
    return Problem(availability.DISCOVERY_NOT_READY, text)


def _restart(observed: Observed) -> Problem | None:
    """Return why the workload's own controller cannot run a pod, or None."""
    own = [p for p in observed.instances if names.POOL not in kube_objects.labels(p) and kube_objects.alive(p)]
    return None if any(kube_objects.ready(pod) for pod in own) else _problem(own)


def _beside_active(observed: Observed, found: Sequence[Object]) -> bool:
    """Return whether all of these pods would be lost with the node of the active pod."""
    active = kube_objects.active(observed.gate)[1]
    its = next((leaving_nodes.of(pod) for pod in observed.instances if kube_objects.uid(pod) == active), "")
    return its != "" and all(leaving_nodes.of(pod) == its for pod in found)
