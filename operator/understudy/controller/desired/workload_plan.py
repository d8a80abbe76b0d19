"""Evaluates a RobotWorkload's spec: whether it is valid, and which pods it needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.desired import (
    action_proxy_container,
    discovery_server,
    monitor_memory,
    mux_validation,
    reflex_validation,
)
from understudy.controller.desired.monitor_memory import MonitorMemory
from understudy.controller.observed import kube_objects, policy_reader, pool_reader, tree_verdicts, workload_reference
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import Images, Problem
from understudy.controller.pods import instance_pod, ros_environment
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.ros.rmw import MIDDLEWARE


@dataclass(frozen=True)
class WorkloadPlan:
    """The result of evaluating a workload's spec."""

    spec: RobotWorkloadSpec | None = None
    problem: Problem | None = None
    """Why the spec cannot be followed."""
    policy_problem: Problem | None = None
    template: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, str] | None = None
    """ROS environment; None while the address of the discovery server is unknown."""
    profiles: str = ""
    """DDS profiles of the instances; empty if they need none."""
    builts: Mapping[str, Object] = field(default_factory=dict)
    """Built pod templates: of the workload's own ReplicaSet ("") and of the standbys of each pool."""
    memory: MonitorMemory | None = None
    """The memory limit of the monitor; None without a valid policy."""


_BRING_UP = "spec.bringUp"


def evaluate(observed: Observed, images: Images) -> WorkloadPlan:
    """Evaluate a workload's spec, before the API server validates its template."""
    workload = observed.workload
    name, namespace = kube_objects.name(workload), workload["metadata"]["namespace"]
    try:
        spec = RobotWorkloadSpec.model_validate(workload.get("spec") or {})
    except ValidationError as error:
        return WorkloadPlan(problem=Problem("SpecInvalid", policy_reader.invalid(error)))
    policy = _policy_problem(observed, spec)
    trees = ((f"spec.dependsOn[{index}].procedure", one.procedure) for index, one in enumerate(spec.depends_on))
    if refused := policy_reader.procedures_problem((_BRING_UP, spec.bring_up), *trees):
        return WorkloadPlan(spec=spec, problem=refused, policy_problem=policy)

    def refuse(problem: Problem) -> WorkloadPlan:
        return WorkloadPlan(spec=spec, problem=problem, policy_problem=policy)

    try:
        ros_environment.config_maps(name, {}, spec.outputs, spec.gate)
    except ValueError as error:
        return refuse(Problem("PortsExhausted", str(error)))
    template, path, stripped = spec.template or {}, "spec.template", frozenset[str]()
    if spec.workload_ref is not None:
        referred = observed.reference or workload_reference.ReferencedObjects()
        if found := workload_reference.problem(spec.workload_ref, referred, observed.rivals, namespace):
            return refuse(found)
        assert referred.controller is not None
        template = referred.controller["spec"]["template"]
        path = f"{spec.workload_ref.kind} {spec.workload_ref.name}: spec.template"
        stripped = workload_reference.label_keys(referred)
    if words := instance_pod.problem(template, held=False, path=path, gate=registry.KINDS[spec.gate.kind]):
        return refuse(Problem("TemplateInvalid", words))
    if words := reflex_validation.problem(spec, template):
        return refuse(Problem("ReflexUnsafe", words))
    if words := mux_validation.problem(spec, template):
        return refuse(Problem("NotMuxable", words))
    service = observed.owned.get(("services", names.discovery(name)))
    address = discovery_server.address(service)
    if spec.ros.discovery.mode == "Managed" and address is None:
        return WorkloadPlan(spec=spec, policy_problem=policy, template=template)
    environment = MIDDLEWARE.environment(spec.ros, address)
    own_images = replace(images, monitor=spec.monitor.image or images.monitor)
    profiles = action_proxy_container.instance_profiles(spec)

    def build(pool: str) -> Object:
        recipe = instance_pod.Recipe(
            workload=name,
            namespace=namespace,
            images=own_images,
            agent_protocol=instance_pod.agent_protocol(own_images.monitor, [workload]),
            secret=names.agent_secret(name),
            environment=environment,
            pool=pool,
            stripped=stripped,
            profiles=profiles,
            procedure=_procedure(observed, spec, pool) if pool else "",
        )
        return instance_pod.build(template, recipe)

    builts = {pool: build(pool) for pool in observed.standby_pools}
    if spec.template is not None:
        builts[""] = build("")
    memory = None if policy else monitor_memory.memory(_policy(observed, spec), images)
    return WorkloadPlan(spec, None, policy, template, environment, profiles, builts, memory)


def probe_template(observed: Observed, workload_plan: WorkloadPlan) -> Object | None:
    """Return a pod with which the API server can validate the template; None if no template was built."""
    if not workload_plan.builts:
        return None
    return instance_pod.trial(workload_plan.builts[min(workload_plan.builts)], "RobotWorkload", observed.workload)


def _policy(observed: Observed, spec: RobotWorkloadSpec) -> FailurePolicySpec:
    return policy_reader.spec(observed.policies[spec.failure_policy_ref.name])


def _policy_problem(observed: Observed, spec: RobotWorkloadSpec) -> Problem | None:
    """Return why the workload's policy cannot be used, or None."""
    name = spec.failure_policy_ref.name
    policy = observed.policies.get(name)
    if policy is None:
        return Problem(
            "PolicyNotFound",
            f'spec.failurePolicyRef.name: no FailurePolicy "{name}" in namespace '
            f"{observed.workload['metadata']['namespace']} ({kube_objects.hint(name, observed.policies)}). "
            f"Create it or correct the name",
        )
    if found := policy_reader.problem(policy, observed.config_maps):
        return Problem("PolicyNotAccepted", f"FailurePolicy {name}: {found.message}")
    return None


def _procedure(observed: Observed, spec: RobotWorkloadSpec, pool: str) -> str:
    """Return the tree that initializes a pool's standbys, as text in the short form.

    It is empty if there is none, or if the pool is not accepted.
    """
    if observed.refused(pool) is not None:
        return ""
    parsed = pool_reader.spec(observed.pools[pool])
    found, path = parsed.initialization, pool_reader.INITIALIZATION
    if found is None and parsed.level.runs_in_full:
        found, path = spec.bring_up, _BRING_UP
    return tree_verdicts.of(policy_reader.procedure(found, path)).tree if found is not None else ""
