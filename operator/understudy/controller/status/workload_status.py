"""The status of a workload: whether it is accepted, built and protected, and with which strategies and pods."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from understudy.advice import order_explanation
from understudy.api import names
from understudy.api.conditions import Condition, condition, is_summary, merged, summary
from understudy.api.kinds.failure_policy import Strategy
from understudy.controller.desired import effective_policy, monitor_memory, node_drain, standby_pods
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import (
    dependency_graph,
    kube_objects,
    leaving_nodes,
    pod_diagnosis,
    policy_reader,
    pool_reader,
    situation_strategies,
)
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import Problem
from understudy.controller.status import policy_map_room, protection
from understudy.kube.client import Object

PROGRESSING = frozenset(
    {
        "MonitorNotReady",
        "StandbyNotReady",
        "PodsReserved",
        "DiscoveryNotReady",
        "InProgress",
        "PodsNotReady",
        "GateMissing",
        "FewFail",
    }
)
"""Reasons that are normal while something is being built. Their first occurrence causes no Event."""

UNTOLD = frozenset({"Available", "Updated"})
"""Conditions without Events.

Ready reports an empty pool, and so do the monitors of the workloads that wait for it. Reconciled reports a pool whose
new pods cannot start.
"""

READY = ("Accepted", "Reconciled", "Protected")
"""The conditions that a workload must meet to be Ready. Its robot's health is not one of them: a workload under recovery is set up."""

CHOSEN = "StrategiesChosen"
"""The condition with the selected order and its reasons, for workloads whose policy leaves the order open."""


def status(
    observed: Observed, workload_plan: WorkloadPlan, problems: Sequence[Problem], resized: Condition | None = None
) -> Object:
    """Return the operator's part of a workload's status, without the times of its conditions.

    ``problems`` are the API server's refusals of writes; ``resized`` is the condition for resizes of the active pod.
    """
    workload = observed.workload
    conditions = [
        _accepted(workload_plan, problems),
        _reconciled(observed, workload_plan, problems),
        protection.protected(observed, workload_plan),
        *_chosen(observed, workload_plan),
        *_situation(observed, workload_plan),
        *_memory(observed, workload_plan),
        *dependency_graph.resolved(observed.dependencies, workload),
        *([resized] if resized is not None else []),
        *node_drain.conditions(observed, workload_plan),
        *_policy_map(observed),
    ]
    return {
        "standby": protection.standby(observed, workload_plan),
        **protection.stocked(observed, workload_plan),
        **_order(observed, workload_plan),
        **kube_objects.status(workload, [summary(conditions, READY), *conditions]),
    }


def timed(live: Object, desired: Object) -> Object:
    """Return a status whose conditions keep the live transition times if their status has not changed."""
    old = [Condition.model_validate(c) for c in (live.get("status") or {}).get("conditions") or []]
    new = [Condition.model_validate(c) for c in desired["conditions"]]
    return {**desired, "conditions": [c.to_wire() for c in merged(old, new)]}


def transitions(live: Object, desired: Object) -> list[Object]:
    """Return the conditions to report as Events: those whose status or reason has changed, except for normal progress."""
    old = {c["type"]: c for c in (live.get("status") or {}).get("conditions") or []}
    found = []
    for new in desired["conditions"]:
        before = old.get(new["type"])
        if is_summary(new, desired["conditions"]):
            continue
        if new["type"] in UNTOLD or new["reason"] in protection.LIMIT_CONDITIONS.values():
            continue
        if before is not None and (before["status"], before["reason"]) == (new["status"], new["reason"]):
            continue
        was_not_true = before is None or before["status"] != "True"
        if was_not_true and new["status"] == "False" and new["reason"] in PROGRESSING:
            continue
        found.append(new)
    return found


def _accepted(workload_plan: WorkloadPlan, problems: Sequence[Problem]) -> Condition:
    taken = next((p for p in problems if p.reason in ("NameTaken", "TemplateInvalid")), None)
    found = workload_plan.problem or workload_plan.policy_problem or taken
    if found is not None:
        return condition("Accepted", False, found.reason, found.message)
    return condition("Accepted", True, "Accepted", "The spec and the policy are valid.")


def _reconciled(observed: Observed, workload_plan: WorkloadPlan, problems: Sequence[Problem]) -> Condition:
    no = partial(condition, "Reconciled", False)
    if workload_plan.problem is not None:
        return no("NotAccepted", "The spec is invalid: see Accepted. Existing objects stay unchanged.")
    if problems:
        return no(problems[0].reason, "; ".join(problem.message for problem in problems))
    if workload_plan.environment is None:
        return no("InProgress", "Waiting for the address of the discovery server's Service.")
    kept = standby_pods.awaited(observed, workload_plan)
    # If no node accepts a standby that must be elsewhere, the present ones stay, and nothing is missing: unless their node is about to go.
    staying = {kube_objects.uid(p) for p in observed.pods if not leaving_nodes.on(p, observed.leaving)}
    unplaced = [
        p
        for p in observed.instances
        if kube_objects.notes(p).get(names.REPLACES) in staying and not leaving_nodes.of(p)
    ]
    if found := pod_diagnosis.first([pod for pod in observed.instances if pod not in unplaced]):
        return no(found.reason, f"{found.message} {kept}." if kept else found.message)
    if kept:
        return no("InProgress", f"{kept}.")
    return condition("Reconciled", True, "Reconciled", "All objects match the spec.")


def _order(observed: Observed, workload_plan: WorkloadPlan) -> Object:
    """Return the strategies in force, in short form; the last known ones while the policy is missing or invalid."""
    if workload_plan.spec is None or workload_plan.policy_problem is not None:
        known = (observed.workload.get("status") or {}).get("strategies")
        return {"strategies": known} if known else {}
    return {"strategies": ", ".join(_short(observed, one) for one in effective_policy.strategies(observed))}


def _short(observed: Observed, strategy: Strategy) -> str:
    if strategy.pool_ref is None:
        return strategy.type
    name = strategy.pool_ref.name
    pool = observed.pools.get(name)
    return f"{pool_reader.readiness(pool) if pool is not None else strategy.type} ({name})"


def takes_from(strategies: str, pool: str) -> bool:
    """Whether one of the strategies in a status (in short form) takes instances from a pool."""
    return f"({pool})" in strategies


def _memory(observed: Observed, workload_plan: WorkloadPlan) -> list[Condition]:
    """Return the condition for the monitor's memory. While the policy is missing or invalid, the last condition stays."""
    spec = workload_plan.spec
    if spec is None or spec.monitor.resources is not None:
        return []
    if workload_plan.memory is None:
        return _last(observed, monitor_memory.CONDITION)
    name = spec.failure_policy_ref.name
    return monitor_memory.judged(workload_plan.memory, name, policy_reader.spec(observed.policies[name]))


def _policy_map(observed: Observed) -> list[Condition]:
    """Return the condition for the room in Cilium's policy map. Until the operator has looked, the last condition stays."""
    if not observed.policy_map_known:
        return _last(observed, policy_map_room.CONDITION)
    return policy_map_room.conditions(observed.policy_map)


def _last(observed: Observed, type_: str) -> list[Condition]:
    live = (observed.workload.get("status") or {}).get("conditions") or []
    return [Condition.model_validate(one) for one in live if one["type"] == type_]


def _chosen(observed: Observed, workload_plan: WorkloadPlan) -> list[Condition]:
    """Return the condition for the selected order, if the policy leaves it open.

    While the policy is missing or invalid, the last condition stays.
    """
    if workload_plan.spec is None or workload_plan.policy_problem is not None:
        return _last(observed, CHOSEN)
    order = effective_policy.order(observed)
    if order is None:
        return []
    message, present = order_explanation.explain(order), _order(observed, workload_plan)["strategies"]
    if present != order_explanation.one_line(order):
        message += f" Until the recovery in progress ends, the order stays {present}."
    met = not order_explanation.unmet_requirements(order)
    why = "Chosen" if met else "RequirementsNotMet"
    return [condition(CHOSEN, met, why, message)]


def _situation(observed: Observed, workload_plan: WorkloadPlan) -> list[Condition]:
    """Return the condition that reports whether the strategies of the robot's situation are in force.

    While the policy is missing or invalid, the last condition stays.
    """
    if workload_plan.spec is None or workload_plan.policy_problem is not None:
        return _last(observed, situation_strategies.CONDITION)
    policy = observed.policies[workload_plan.spec.failure_policy_ref.name]
    if not situation_strategies.has_some(policy):
        return []
    asked, in_force = situation_strategies.asked(observed.workload, policy), effective_policy.situation(observed)
    order, lacking = _order(observed, workload_plan)["strategies"], effective_policy.lacking(observed)
    reason, message = situation_strategies.description(asked, in_force, order, lacking)
    return [condition(situation_strategies.CONDITION, asked == in_force, reason, message)]
