"""Delays node drains while the active instance runs on the node.

A PodDisruptionBudget delays evictions of that instance until its monitor has switched over to an understudy on another
node, or until the workload's time limit has passed. The operator watches the nodes and informs the monitor, so that the
monitor needs few rights.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.switchover_spec import Drain
from understudy.controller.desired import effective_policy
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import kube_objects, leaving_nodes
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import pool_evictions
from understudy.kube.client import DISRUPTION_BUDGETS, Object

CONDITION = "Draining"


def drain_of(observed: Observed) -> Drain | None:
    """Return the drain to report to the monitor; None unless the node of the active instance is cordoned."""
    active, cordoned = observed.active, observed.cordoned
    if active is None or (node := leaving_nodes.of(active)) not in cordoned:
        return None
    settings, uid, now = observed.written_settings, kube_objects.uid(active), round(observed.now, 3)
    present = settings.drain if settings is not None else None
    since = min(present.since, now) if present is not None and (present.uid, present.node) == (uid, node) else now
    return Drain(uid=uid, node=node, since=since, cordoned=sorted(cordoned))


def held_in_vain(observed: Observed) -> bool:
    """Whether the budget refuses evictions from a cordoned node although no switchover will come that they could wait for.

    That is so while the gate is closed, or the monitor is not informed of the drain because the spec is refused.
    """
    live = observed.owned.get((DISRUPTION_BUDGETS.plural, names.in_control(kube_objects.name(observed.workload))))
    if live is None or kube_objects.deleted(live):
        return False
    selected = [pod for pod in observed.pods if pool_evictions.selects(live, kube_objects.labels(pod))]
    return any(kube_objects.alive(pod) and leaving_nodes.on(pod, observed.cordoned) for pod in selected)


@dataclass(frozen=True)
class Hold:
    """Whether evictions of the active instance are delayed, and why."""

    reason: str
    message: str
    holds: bool = False
    until: float | None = None
    """End of the delay, in Unix seconds; None while no node is drained."""


def hold(observed: Observed, workload_plan: WorkloadPlan) -> Hold:
    """Return whether evictions of the active instance are delayed for an understudy, and the reason if not."""
    assert workload_plan.spec is not None
    active, asked = observed.active, workload_plan.spec.draining
    if active is None:
        return Hold("NoneInControl", "there is no active instance")
    length = seconds(asked.hold_for)
    if not length:
        return Hold("NotAskedFor", "spec.draining.holdFor is 0s")
    if not _falls_back(observed, workload_plan):
        return Hold(
            "NoFallback",
            "the policy has no Fallback with a pool that serves this workload, so no standby can take over first",
        )
    if other := next(
        (kube_objects.name(b) for b in observed.budgets if pool_evictions.selects(b, kube_objects.labels(active))), None
    ):
        # With two budgets, Kubernetes refuses every eviction permanently.
        return Hold(
            "OtherBudget",
            f"PodDisruptionBudget {other}, which Understudy does not manage, selects this pod, and a pod can have only one",
        )
    if (drain := drain_of(observed)) is None:
        return Hold("Held", "", holds=True)
    until = drain.since + length
    if observed.now >= until:
        words = f"no instance on another node took over within {asked.hold_for}; see status.switchover for the reason"
        return Hold("HoldEnded", words)
    return Hold("Held", "", holds=True, until=until)


def _falls_back(observed: Observed, workload_plan: WorkloadPlan) -> bool:
    """Whether the workload's policy has a pool that serves it; if the policy is missing or invalid, whether it had one."""
    if workload_plan.policy_problem is not None:
        return bool(observed.written_pools)
    served = observed.serving
    return any(name in served for name in effective_policy.named_pools(effective_policy.strategies(observed)))


def budget(workload: str, active: Object) -> Object:
    """Return the budget that makes the API server refuse evictions of the active instance for now (429).

    Drain tools then retry. An instance that is not ready does not wait, because an unhealthy instance fails over
    anyway.
    """
    chosen = {names.INSTANCE: kube_objects.name(active)}
    return pool_evictions.disruption_budget(names.in_control(workload), 1, chosen)


def conditions(observed: Observed, workload_plan: WorkloadPlan) -> list[Condition]:
    """Return the condition Draining; empty unless the node is drained."""
    active, drain = observed.active, drain_of(observed)
    if drain is None or active is None:
        return []
    if workload_plan.problem is None and workload_plan.spec is not None:
        found = hold(observed, workload_plan)
    else:
        found = Hold("NotAccepted", "the spec is not accepted (see Accepted), so no switchover is prepared")
    message = f"Node {drain.node}, where the active instance {kube_objects.name(active)} runs, is cordoned."
    if not found.holds:
        then = f"Understudy does not delay evictions of this pod: {found.message}."
        return [condition(CONDITION, False, found.reason, f"{message} {then}")]
    clock = datetime.fromtimestamp(found.until or 0.0, UTC).strftime("%H:%M:%S UTC")
    then = (
        "A PodDisruptionBudget refuses evictions of this pod until an instance on another node has taken "
        f"over, at the latest until {clock}."
    )
    return [condition(CONDITION, True, found.reason, f"{message} {then}")]
