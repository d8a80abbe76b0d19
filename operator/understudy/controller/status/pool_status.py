"""The status of FallbackPools: numbers and conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

from understudy.api import names
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.controller.observed import kube_objects, leaving_nodes, pool_reader
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.controller.plan import UNANSWERED, Problem
from understudy.controller.pods import instance_pod, pod_counts, pool_pods, pool_size
from understudy.controller.pods.pool_size import Sized
from understudy.kube import claims, selectors
from understudy.kube.client import Object
from understudy.kube.gates import pool_pod_policies

_MOST_NAMED = 3


@dataclass(frozen=True)
class Counts:
    """The numbers of a pool."""

    replicas: int
    desired: int
    ready: int
    claimed: int


def count(observed: pool_pods.Observed, spec: FallbackPoolSpec, sized: Sized | None = None) -> Counts:
    """Return the numbers of a pool's status."""
    living = [pod for pod in observed.pods if kube_objects.alive(pod)]
    if spec.level.shared:
        held = _held(observed)
        policy = observed.owned.get((pool_pod_policies.RESOURCE.plural, names.held(kube_objects.name(observed.pool))))
        return Counts(
            replicas=len(held),
            desired=pool_size.wanted(spec, sized),
            ready=len(pool_pods.claimable_now(held, policy)),
            claimed=len(living) - len(held),
        )
    driving = [pod for pod in living if kube_objects.uid(pod) in observed.active]
    waiting = [*(pod for pod in living if pod not in driving), *observed.replacement_standbys]
    served = sum(pool_reader.serves(observed.pool, workload) for workload in observed.workloads.values())
    return Counts(
        replicas=len(waiting),
        desired=(served - observed.spared) * (spec.per_workload or 0) + observed.prewarmed,
        ready=sum(kube_objects.ready(pod) for pod in waiting),
        claimed=len(driving),
    )


def _held(observed: pool_pods.Observed) -> list[Object]:
    """Return the living pods that are unclaimed."""
    return [pod for pod in observed.pods if kube_objects.alive(pod) and claims.is_held(kube_objects.labels(pod))]


def status(observed: pool_pods.Observed, pool_plan: pool_pods.PoolPlan, problems: Sequence[Problem]) -> Object:
    """Return the pool's status, without the times of its conditions."""
    pool, spec = observed.pool, pool_plan.spec
    # A webhook that does not answer is not a problem of the pool's spec.
    found = pool_plan.problem or next((one for one in problems if one.reason != UNANSWERED), None)
    if found is not None:
        accepted = condition("Accepted", False, found.reason, found.message)
    else:
        accepted = condition("Accepted", True, "Accepted", "The spec is valid.")
    result: Object = {}
    if spec is not None:
        counts = count(observed, spec, pool_plan.sized)
        result |= {
            "replicas": counts.replicas,
            "desired": counts.desired,
            "ready": counts.ready,
            "claimed": counts.claimed,
            "selector": _selector(kube_objects.name(pool), spec),
        }
        conditions = [accepted, _reconciled(observed, problems, found), _ready(observed, counts, found)]
        if spec.level.shared:
            result["waiting"] = len(observed.waiting)
            conditions.append(_available(observed, spec, counts))
            if pool_plan.built is not None:
                present = instance_pod.template_hash(pool_plan.built)
                result["updated"] = sum(pod_counts.hash_of(pod) == present for pod in _held(observed))
                conditions.append(_updated(spec, counts, result["updated"]))
        if pool_plan.sized is not None:
            result |= pool_size.status(pool_plan.sized)
            conditions.append(pool_size.judged(pool_plan.sized))
        conditions += _moving(observed)
    else:
        result |= pool_size.last(pool)
        conditions = [accepted]
    return result | kube_objects.status(pool, conditions)


def _reconciled(observed: pool_pods.Observed, problems: Sequence[Problem], found: Problem | None) -> Condition:
    no = partial(condition, "Reconciled", False)
    if problems:
        return no(problems[0].reason, "; ".join(problem.message for problem in problems))
    if found is not None:
        return no("NotAccepted", "The spec is invalid: see Accepted. Existing pods are kept.")
    for pod in sorted(observed.pods, key=kube_objects.sort_key):
        if bad := trouble(pod):
            return no(bad.reason, bad.message)
    return condition("Reconciled", True, "Reconciled", "All objects match the spec.")


def _selector(name: str, spec: FallbackPoolSpec) -> str:
    text = f"{names.POOL}={name}"
    return f"{text},{names.HELD}=true,{names.CLAIMED_BY}={names.UNCLAIMED}" if spec.level.shared else text


def _ready(observed: pool_pods.Observed, counts: Counts, problem: Problem | None) -> Condition:
    pool = observed.pool
    no = partial(condition, "Ready", False)
    if not any(pool_reader.serves(pool, workload) for workload in observed.workloads.values()):
        selector = selectors.as_text((pool.get("spec") or {}).get("workloadSelector") or {})
        return no(
            "NoMatchingWorkload",
            f"spec.workloadSelector ({selector or 'everything'}) matches none of the {len(observed.workloads)} "
            f"RobotWorkloads in namespace {pool['metadata']['namespace']}: correct it, or put its labels on the "
            f"RobotWorkload (on its own metadata, not on its template)",
        )
    if counts.ready >= counts.desired:
        return condition("Ready", True, "Ready", f"{counts.ready} can take over now.")
    if problem is not None:
        return no(
            "NotAccepted", f"{counts.ready} of {counts.desired} are ready, and no more pods are created: see Accepted."
        )
    for pod in sorted([*observed.pods, *observed.replacement_standbys], key=kube_objects.sort_key):
        if found := trouble(pod):
            return no(found.reason, f"{counts.ready} of {counts.desired} are ready; {found.message}")
    state = f"{counts.ready} of {counts.desired} are ready"
    if pool_reader.is_shared(pool):
        return no("PodsNotReady", f"{state}.")
    served = sorted(name for name, workload in observed.workloads.items() if pool_reader.serves(pool, workload))
    return no("PodsNotReady", f"{state}; see the condition BroughtUp of {_named(served)}.")


def _available(observed: pool_pods.Observed, spec: FallbackPoolSpec, counts: Counts) -> Condition:
    """Return the condition Available: whether a robot that fails now would receive a pod, and which workloads wait for one."""
    found = [f"{one.workload} (poolPriority {one.priority}, since {_moment(one.since)})" for one in observed.waiting]
    message = f"{counts.ready} of {counts.desired} can be claimed now"
    if spec.reserve is not None:
        message = (
            f"{message}, the last {spec.reserve.pods} only with poolPriority {spec.reserve.pool_priority} or higher"
        )
    if found:
        more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
        message = f"{message}; workloads that wait, in this order: {', '.join(found[:_MOST_NAMED])}{more}"
    free = counts.ready > len(found)
    return condition("Available", free, "Available" if free else "Dry", f"{message}.")


def _moving(observed: pool_pods.Observed) -> list[Condition]:
    """Return the condition for pods whose node is about to go; empty if there are none."""
    made = [pod for pod in observed.pods if kube_objects.alive(pod) and kube_objects.uid(pod) not in observed.active]
    waiting = [*made, *observed.replacement_standbys]
    unclaimed = [pod for pod in waiting if names.CLAIM not in kube_objects.notes(pod)]
    if pool_pods.stranded(observed, unclaimed):
        message = "Every node is being drained, so no unclaimed pod is replaced. Evictions of these pods do not wait."
        return [condition(pool_pods.MOVING, False, "NoOtherNode", message)]
    found = [pod for pod in unclaimed if leaving_nodes.on(pod, observed.leaving)]
    if not found:
        return []
    places = sorted({leaving_nodes.of(pod) for pod in found})
    more = f" and {len(places) - _MOST_NAMED} more" if len(places) > _MOST_NAMED else ""
    message = (
        f"{len(found)} of {len(waiting)} unclaimed pods {'is' if len(found) == 1 else 'are'} on a node that is being drained or was lost "
        f"({', '.join(places[:_MOST_NAMED])}{more}). The operator deletes such pods after replacements on other nodes are ready."
    )
    return [condition(pool_pods.MOVING, True, "NodeLeaves", message)]


def _updated(spec: FallbackPoolSpec, counts: Counts, updated: int) -> Condition:
    """Return the condition Updated: the progress of a change of the template."""
    old = counts.replicas - updated
    if not old:
        message = "Every unclaimed pod has the current template."
        return condition("Updated", True, "Updated", message)
    are = "has an earlier template and is kept" if old == 1 else "have earlier templates and are kept"
    message = f"{old} of {counts.replicas} unclaimed pods {are}"
    if spec.update_strategy is not None and spec.update_strategy.type == "OnReplenish":
        message = f"{message} until workloads claim them (spec.updateStrategy)."
        return condition("Updated", True, "OnReplenish", message)
    message = f"{message} until enough pods of the current template are ready."
    return condition("Updated", False, "RollingOut", message)


def _moment(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S UTC")


def _named(workloads: Sequence[str]) -> str:
    """Return workloads for a message whose length does not grow with their number."""
    if len(workloads) > _MOST_NAMED:
        return f"its {len(workloads)} RobotWorkloads"
    return f"RobotWorkload {', '.join(workloads)}"
