"""The settings of a workload's monitor. The monitor reads them from a ConfigMap, and again when they change."""

from __future__ import annotations

import json
from collections.abc import Mapping

from understudy.api import names
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.controller import plan
from understudy.controller.desired import action_proxy_container, effective_policy, node_drain
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import dependency_graph, kube_objects, pool_reader
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import instance_pod, pool_pods
from understudy.kube.client import Object


def config_map(observed: Observed, workload_plan: WorkloadPlan, environment: Mapping[str, str]) -> Object:
    """Return the ConfigMap with the monitor's settings."""
    assert workload_plan.spec is not None
    workload = observed.workload
    kind, name = source(observed, workload_plan)
    selector: dict[str, str] = {}
    if observed.reference is not None and observed.reference.controller is not None:
        selector = observed.reference.controller["spec"]["selector"].get("matchLabels") or {}
    settings = WorkloadSettings(
        workload=kube_objects.name(workload),
        namespace=workload["metadata"]["namespace"],
        uid=kube_objects.uid(workload),
        source_kind=kind,
        source_name=name,
        source_selector=selector,
        ros_environment=dict(environment),
        container_environment=instance_pod.literal_environment(workload_plan.template, environment),
        instance_profiles=workload_plan.profiles,
        tasks_problem=action_proxy_container.problem(
            kube_objects.name(workload), workload_plan.spec, workload_plan.template
        ),
        pools=choices(observed, workload_plan),
        drain=node_drain.drain_of(observed),
        strategies=effective_policy.chosen(observed),
        situation=_situation(observed),
        upstream=dependency_graph.upstream(observed.dependencies, kube_objects.name(workload)),
    )
    # Sorted and indented, because people read it to find the cause of a problem.
    text = json.dumps(settings.to_wire(), indent=1, sort_keys=True)
    return plan.config_map(names.settings(kube_objects.name(workload)), {"settings.json": text})


def choices(observed: Observed, workload_plan: WorkloadPlan) -> list[PoolChoice]:
    """Return the pools that the strategies name and that serve the workload, those in force first.

    While the policy is missing or invalid, these are the last known pools.
    """
    assert workload_plan.spec is not None
    if workload_plan.policy_problem is not None:
        return observed.written_pools
    served = observed.serving
    present = {choice.name: choice for choice in observed.written_pools}
    found = []
    chosen = effective_policy.strategies(observed)
    first = effective_policy.named_pools(chosen)
    for name in (*first, *sorted(effective_policy.counted_on(observed, chosen).difference(first))):
        if name not in served:
            continue
        if observed.refused(name) is not None:
            # Its standbys were created and initialized with the settings that were last accepted, so these still apply.
            found += [present[name]] if name in present else []
            continue
        pool = pool_reader.spec(served[name])
        keep_up = pool.keep_up.period if pool.keep_up and pool.level.is_prepared else None
        allowed = pool_pods.claimable_hash(observed.held_policies.get(name)) if pool.level.shared else ""
        choice = PoolChoice(
            name=name,
            readiness=pool.readiness,
            template_hash=allowed,
            reserved=pool.kept_from(workload_plan.spec.pool_priority),
            initialization=pool.initialization,
            readiness_check=pool.readiness_check,
            keep_up=keep_up,
        )
        found.append(choice)
    return found


def source(observed: Observed, workload_plan: WorkloadPlan) -> tuple[str, str]:
    """Return kind and name of the controller that creates the workload's own pods."""
    assert workload_plan.spec is not None
    reference = workload_plan.spec.workload_ref
    return (reference.kind, reference.name) if reference else ("ReplicaSet", kube_objects.name(observed.workload))


def _situation(observed: Observed) -> str | None:
    """Return the situation whose strategies the settings contain, or None."""
    if observed.policy is None:
        settings = observed.written_settings
        return settings.situation if settings is not None else None
    return effective_policy.situation(observed) or None
