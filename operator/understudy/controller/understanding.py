"""What a RobotWorkload's spec comes to: whether it can be followed, and the pods that it asks for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import ValidationError

from understudy.api import names
from understudy.api.workloads import RobotWorkloadSpec
from understudy.cluster.client import Object
from understudy.controller import discovery, instances, objects, policies, references, reflexes, robots, tasking
from understudy.controller.desired import Images, Problem
from understudy.controller.observed import Observed
from understudy.trees.procedureforms import composed


@dataclass(frozen=True)
class Understanding:
    """What a workload's spec comes to."""

    spec: RobotWorkloadSpec | None = None
    problem: Problem | None = None
    """Why its spec can't be followed."""
    policy_problem: Problem | None = None
    template: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, str] | None = None
    """ROS environment; None while the discovery server's address isn't known."""
    profiles: str = ""
    """DDS profiles of the instances; empty where they need none."""
    builts: Mapping[str, Object] = field(default_factory=dict)
    """Built pod templates: of its own ReplicaSet ("") and of the standbys of each pool."""


def understand(observed: Observed, images: Images) -> Understanding:
    """What a workload's spec comes to, before the API server has judged its template."""
    workload = observed.workload
    name, namespace = objects.name(workload), workload["metadata"]["namespace"]
    try:
        spec = RobotWorkloadSpec.model_validate(workload.get("spec") or {})
    except ValidationError as error:
        return Understanding(problem=Problem("SpecInvalid", policies.invalid(error)))
    policy = _policy_problem(observed, spec)
    trees = ((f"spec.dependsOn[{index}].procedure", one.procedure) for index, one in enumerate(spec.depends_on))
    if words := policies.procedures_problem(("spec.bringUp", spec.bring_up), *trees):
        return Understanding(spec=spec, problem=Problem("TreeInvalid", words), policy_problem=policy)

    def refuse(problem: Problem) -> Understanding:
        return Understanding(spec=spec, problem=problem, policy_problem=policy)

    try:
        robots.config_maps(name, {}, spec.outputs)
    except ValueError as error:
        return refuse(Problem("PortsExhausted", str(error)))
    template, path, stripped = spec.template or {}, "spec.template", frozenset[str]()
    if spec.workload_ref is not None:
        referred = observed.reference or references.Referred()
        if found := references.problem(spec.workload_ref, referred, observed.rivals, namespace):
            return refuse(found)
        assert referred.controller is not None
        template = referred.controller["spec"]["template"]
        path = f"{spec.workload_ref.kind} {spec.workload_ref.name}: spec.template"
        stripped = references.label_keys(referred)
    if words := instances.problem(template, held=False, path=path):
        return refuse(Problem("TemplateInvalid", words))
    if words := reflexes.problem(spec, template):
        return refuse(Problem("ReflexUnsafe", words))
    service = observed.owned.get(("services", names.discovery(name)))
    address = discovery.address(service)
    if spec.ros.discovery.mode == "Managed" and address is None:
        return Understanding(spec=spec, policy_problem=policy, template=template)
    environment = robots.ros_environment(spec.ros, address)
    own_images = replace(images, monitor=spec.monitor.image or images.monitor)
    profiles = tasking.instance_profiles(spec)

    def build(pool: str) -> Object:
        recipe = instances.Recipe(
            workload=name,
            namespace=namespace,
            images=own_images,
            secret=names.agent_secret(name),
            environment=environment,
            pool=pool,
            stripped=stripped,
            profiles=profiles,
            procedure=_procedure(observed, spec, pool) if pool else "",
        )
        return instances.build(template, recipe)

    builts = {pool: build(pool) for pool in observed.standby_pools}
    if spec.template is not None:
        builts[""] = build("")
    return Understanding(spec, None, policy, template, environment, profiles, builts)


def probe_template(observed: Observed, understanding: Understanding) -> Object | None:
    """A pod by which the API server can judge the template; None where none was built."""
    if not understanding.builts:
        return None
    return instances.trial(understanding.builts[min(understanding.builts)], "RobotWorkload", observed.workload)


def _policy_problem(observed: Observed, spec: RobotWorkloadSpec) -> Problem | None:
    """Why the workload's policy can't be followed."""
    name = spec.failure_policy_ref.name
    policy = observed.policies.get(name)
    if policy is None:
        return Problem(
            "PolicyNotFound",
            f'spec.failurePolicyRef.name: no FailurePolicy "{name}" in namespace '
            f"{observed.workload['metadata']['namespace']} ({objects.hint(name, observed.policies)}). "
            f"Create it or correct the name",
        )
    if found := policies.problem(policy, observed.config_maps):
        return Problem("PolicyNotAccepted", f"FailurePolicy {name}: {found.message}")
    return None


def _procedure(observed: Observed, spec: RobotWorkloadSpec, pool: str) -> str:
    """The tree that brings a pool's standbys up, in the short form as text; empty where there is none, or the pool isn't accepted."""
    if observed.refused(pool) is not None:
        return ""
    parsed = policies.pool_spec(observed.pools[pool])
    found = parsed.initialization or (spec.bring_up if parsed.readiness == "Executing" else None)
    return json.dumps(composed(found, path=pool).node, sort_keys=True) if found is not None else ""
