"""RobotWorkloads: from the observed state to the desired objects.

A spec that has a problem changes nothing: the objects that already protect the robot stay. If the policy is missing or
invalid, only the objects that were derived from it stay unchanged. The others are still maintained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.desired import (
    action_proxy_container,
    control_plane_policies,
    discovery_server,
    monitor_config,
    monitor_deployment,
    monitor_memory,
    monitor_placement,
    node_drain,
    standby_pods,
)
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import dependency_graph, kube_objects, ownership, policy_reader, workload_reference
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import Apply, Create, Delete, Images, Patch, Plan, Write
from understudy.controller.pods import claim_tokens, instance_pod, ros_environment
from understudy.controller.pods.pool_pods import UniqueValues
from understudy.kube import claims
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    NETWORK_POLICIES,
    REPLICA_SETS,
    ROLE_BINDINGS,
    ROLES,
    SECRETS,
    SERVICE_ACCOUNTS,
    SERVICES,
    Object,
    Resource,
)
from understudy.kube.gates import pool_pod_policies, registry
from understudy.ros.rmw import MIDDLEWARE

_BY_KIND: dict[str, Resource] = {"ServiceAccount": SERVICE_ACCOUNTS, "Role": ROLES, "RoleBinding": ROLE_BINDINGS}

SWEPT = (DEPLOYMENTS, SERVICES)
"""Resources of which a workload's unneeded objects are deleted (the discovery server)."""


def plan(observed: Observed, workload_plan: WorkloadPlan, images: Images, fresh: UniqueValues) -> Plan:
    """Return the writes for a workload."""
    made = Plan()
    workload, spec = observed.workload, workload_plan.spec
    if kube_objects.deleted(workload):
        return made
    made.writes += labels(observed, workload_plan)
    if workload_plan.problem is not None or spec is None:
        _permit_evictions_in_vain(made, observed)
        return made
    _discover(made, observed, spec, images)
    environment = workload_plan.environment
    if environment is None:
        _permit_evictions_in_vain(made, observed)
        return made
    _gate(made, observed, spec, images)
    _connect_claimed(made, observed, workload_plan, spec)
    _hold(made, observed, workload_plan)
    _configure(made, observed, workload_plan, environment)
    _monitor(made, observed, workload_plan, images, environment)
    if spec.template is not None:
        if standby_pods.awaited(observed, workload_plan) is None:
            body = instance_pod.replica_set(
                workload_plan.builts[""], kube_objects.name(workload), workload["metadata"]["namespace"]
            )
            made.writes.append(_ours(observed, REPLICA_SETS, body))
        standby_pods.scale(made, observed)
    for pool in sorted(workload_plan.builts):
        if pool:
            standby_pods.keep(made, observed, workload_plan, pool, fresh)
    made.writes[:0] = [*_agent_secret(observed, fresh), *_mux_secret(observed, spec, fresh)]
    _sweep(made, observed)
    standby_pods.sweep(made, observed)
    return made


def _agent_secret(observed: Observed, fresh: UniqueValues) -> list[Write]:
    workload, keyed = observed.workload, instance_pod.knows_keys([observed.workload])
    name = names.agent_secret(kube_objects.name(workload))
    if (live := observed.owned.get(("secrets", name))) is None:
        secret = ownership.agent_secret(name, fresh.token, keyed=keyed)
        return [Create(SECRETS, ownership.ours(secret, kube_objects.owner("RobotWorkload", workload), workload))]
    patch = ownership.corrected_keys(live, fresh.token, keyed=keyed)
    return [Patch(SECRETS, live, patch)] if patch is not None else []


def _mux_secret(observed: Observed, spec: RobotWorkloadSpec, fresh: UniqueValues) -> list[Write]:
    """Return the write of the token that only the monitor and the mux know. Agents know another one."""
    name = names.mux(kube_objects.name(observed.workload))
    if not spec.gate.is_at_robot or ("secrets", name) in observed.owned:
        return []
    secret = ownership.agent_secret(name, fresh.token, keyed=False)
    return [
        Create(
            SECRETS, ownership.ours(secret, kube_objects.owner("RobotWorkload", observed.workload), observed.workload)
        )
    ]


def labels(observed: Observed, workload_plan: WorkloadPlan) -> list[Write]:
    """Return the writes that give the observed pods the labels that instances have, and remove them from others."""
    found: list[Write] = list(standby_pods.relabelled(observed, workload_plan))
    if not observed.rivals:
        # With rivals, both workloads would label the same pods in turn, and each time fence the active instance.
        name = kube_objects.name(observed.workload)
        found += workload_reference.labelling(name, observed.pods, observed.reference)
    return found


def abandoned(workload: str, pods: Sequence[Object]) -> Plan:
    """Return the writes for a deleted workload: referred pods lose Understudy's labels.

    Kubernetes collects the owned objects.
    """
    return Plan(writes=list(workload_reference.unlabelling(workload, pods, keep=frozenset())))


def _ours(observed: Observed, resource: Resource, body: Object) -> Apply:
    owner = kube_objects.owner("RobotWorkload", observed.workload)
    return Apply(resource, ownership.ours(body, owner, observed.workload))


def _discover(made: Plan, observed: Observed, spec: RobotWorkloadSpec, images: Images) -> None:
    if spec.ros.discovery.mode != "Managed":
        return
    name = kube_objects.name(observed.workload)
    service = observed.owned.get(("services", names.discovery(name)))
    remembered = None if service else _remembered_address(observed)
    own_images = replace(images, monitor=spec.monitor.image or images.monitor)
    server, changes_after = discovery_server.reminder(observed.discovery, service, observed.now)
    if changes_after is not None:
        made.later(changes_after)
    made.writes.append(_ours(observed, SERVICES, discovery_server.service(name, remembered, server=server)))
    if (address := discovery_server.address(service) or remembered) is not None:
        made.writes.append(_ours(observed, DEPLOYMENTS, discovery_server.deployment(name, own_images, address)))
        made.writes += discovery_server.notes_of_predecessors(observed.discovery)


def _remembered_address(observed: Observed) -> str | None:
    """Return the address of a deleted Service, because the robot's processes still use it."""
    found = observed.owned.get(("configmaps", names.robot_env(kube_objects.name(observed.workload))))
    server = MIDDLEWARE.discovery_server((found or {}).get("data") or {})
    host, colon, port = server.rpartition(":")
    return host.strip("[]") if colon and port == str(names.DISCOVERY_PORT) else None


def _gate(made: Plan, observed: Observed, spec: RobotWorkloadSpec, images: Images) -> None:
    workload = observed.workload
    name, owner = kube_objects.name(workload), kube_objects.owner("RobotWorkload", workload)
    kind, gate, reach = registry.of(workload), observed.gate, control_plane_policies.reach(observed, spec)
    for resource, body in kind.companions(name, reach):
        made.writes.append(_ours(observed, resource, body))
    from_nodes = bool(((spec.template or {}).get("spec") or {}).get("hostNetwork"))
    shield = control_plane_policies.policy(name, reach, images.metrics_from, from_nodes=from_nodes)
    made.writes.append(_ours(observed, NETWORK_POLICIES, shield))
    if gate is None:
        fenced = workload["metadata"]["generation"] if spec.pause is not None and spec.pause.is_fence else 0
        closed = kind.closed(name, reach, epoch=observed.reported_epoch, fenced=fenced)
        made.writes.append(Create(kind.resource, ownership.ours(closed, owner, workload)))
        return
    epoch, paused = observed.reported_epoch, spec.pause is not None
    if repair := kind.repair(gate, reach, owner=owner, labels=kube_objects.MANAGED_BY, epoch=epoch, paused=paused):
        made.writes.append(Patch(kind.resource, gate, repair))


def _connect_claimed(made: Plan, observed: Observed, workload_plan: WorkloadPlan, spec: RobotWorkloadSpec) -> None:
    """Maintain the policy of the pods that the workload has claimed. The monitor names a pod there as soon as it has claimed it."""
    name = kube_objects.name(observed.workload)
    is_there = (NETWORK_POLICIES.plural, names.claimed(name)) in observed.owned
    pools = _commanded(observed, workload_plan)
    if not is_there and not pools:
        return
    reach = control_plane_policies.reach(observed, spec)
    rules = registry.of(observed.workload).instance_rules(name, reach, pools)
    made.writes.append(
        _ours(observed, NETWORK_POLICIES, pool_pod_policies.claimed_pods(name, rules, claims.claimed(observed.pods)))
    )


def _hold(made: Plan, observed: Observed, workload_plan: WorkloadPlan) -> None:
    """Maintain the budget of the active instance.

    During a recovery, when none is active, it stays unchanged. It then selects nothing, or a failed pod that stays.
    """
    found, active, name = (
        node_drain.hold(observed, workload_plan),
        observed.active,
        kube_objects.name(observed.workload),
    )
    if active is None:
        _permit_evictions_in_vain(made, observed)
        return
    live = observed.owned.get((DISRUPTION_BUDGETS.plural, names.in_control(name)))
    if found.holds:
        made.writes.append(_ours(observed, DISRUPTION_BUDGETS, node_drain.budget(name, active)))
    elif live is not None and not kube_objects.deleted(live):
        made.writes.append(Delete(DISRUPTION_BUDGETS, live))
    if found.until is not None:
        made.later(max(0.0, found.until - observed.now))


def _permit_evictions_in_vain(made: Plan, observed: Observed) -> None:
    """Delete the budget if a drain would wait for it without an end."""
    if node_drain.held_in_vain(observed):
        name = names.in_control(kube_objects.name(observed.workload))
        made.writes.append(Delete(DISRUPTION_BUDGETS, observed.owned[DISRUPTION_BUDGETS.plural, name]))


def _configure(made: Plan, observed: Observed, workload_plan: WorkloadPlan, environment: Mapping[str, str]) -> None:
    assert workload_plan.spec is not None
    name = kube_objects.name(observed.workload)
    spec = workload_plan.spec
    namespace = observed.workload["metadata"]["namespace"]
    for body in ros_environment.config_maps(name, environment, spec.outputs, spec.gate, namespace):
        made.writes.append(_ours(observed, CONFIG_MAPS, body))
    if workload_plan.profiles:
        made.writes.append(
            _ours(observed, CONFIG_MAPS, action_proxy_container.profiles_map(name, workload_plan.profiles))
        )
    made.writes.append(_ours(observed, CONFIG_MAPS, monitor_config.config_map(observed, workload_plan, environment)))


def _monitor(
    made: Plan, observed: Observed, workload_plan: WorkloadPlan, images: Images, environment: Mapping[str, str]
) -> None:
    spec = workload_plan.spec
    assert spec is not None
    name, namespace = kube_objects.name(observed.workload), observed.workload["metadata"]["namespace"]
    data = ros_environment.config_maps(name, environment, spec.outputs, spec.gate)[1]["data"]
    key = ros_environment.MONITOR_KEY if ros_environment.MONITOR_KEY in data else ros_environment.PROFILES_KEY
    live = observed.owned.get((DEPLOYMENTS.plural, names.monitor(name)))
    if workload_plan.policy_problem is not None:
        claim = monitor_deployment.claimed(live)
    else:
        claim = policy_reader.spec(observed.policies[spec.failure_policy_ref.name]).state.storage.claim_name
    memory = workload_plan.memory or monitor_memory.unchanged(live, images)
    placement = monitor_placement.placement(observed)
    if placement.again_after is not None:
        made.later(placement.again_after)
    body = monitor_deployment.deployment(
        name,
        namespace,
        spec.monitor,
        images,
        environment,
        (key, data[key]),
        gate=spec.gate.kind,
        tasks=action_proxy_container.proxied(spec),
        claim=claim,
        memory_limit=memory.limit,
        apart_from=placement.apart_from,
    )
    for kind, granted in monitor_deployment.access(
        name,
        source=monitor_config.source(observed, workload_plan),
        policy=spec.failure_policy_ref.name if monitor_deployment.asks_by_name(observed.workload, live, body) else None,
        pools=_commanded(observed, workload_plan),
        upstream=[one.name for one in dependency_graph.upstream(observed.dependencies, name)],
        gate=registry.of(observed.workload),
    ):
        made.writes.append(_ours(observed, _BY_KIND[kind], granted))
    made.writes.append(_ours(observed, DEPLOYMENTS, body))


def _commanded(observed: Observed, workload_plan: WorkloadPlan) -> list[str]:
    """Return the shared pools whose agents the monitor commands.

    These are the pools of its strategies, and those of pods that it has or may have. A claimed pod stays when its pool
    is deleted or no longer used.
    The labels that a monitor may write on its pods give it no new right: the pools of these pods count only if it had
    the right before, or if the pool's selector gives it.
    """
    chosen = {choice.name for choice in monitor_config.choices(observed, workload_plan) if choice.level.shared}
    had = monitor_deployment.commanded(
        observed.owned.get((ROLES.plural, names.monitor(kube_objects.name(observed.workload))))
    )
    return sorted(chosen | (claim_tokens.pools_of(observed.pods) & (had | observed.serving.keys())) | observed.going)


def _sweep(made: Plan, observed: Observed) -> None:
    """Delete the objects that the workload controls and no longer needs."""
    wanted = {(w.resource.plural, kube_objects.name(w.body)) for w in made.writes if isinstance(w, Apply)}
    swept = {resource.plural: resource for resource in SWEPT}
    for (plural, name), item in sorted(observed.owned.items()):
        if plural in swept and (plural, name) not in wanted and not kube_objects.deleted(item):
            made.writes.append(Delete(swept[plural], item))
