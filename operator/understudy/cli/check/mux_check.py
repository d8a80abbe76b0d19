"""Checks the workloads with a mux among the given files, and the pods that run it. A mux may run elsewhere, so most of it are warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from understudy.api import names
from understudy.cli.check import gated_pods
from understudy.cli.manifests import mux_container
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest, at, items
from understudy.ros.rmw import MIDDLEWARE


def check(ours: Sequence[Manifest], others: Sequence[Manifest]) -> Iterator[Finding]:
    """Yield what keeps the muxes of these workloads from working, and fields that have no effect with a mux."""
    for workload in (one for one in ours if one.kind == "RobotWorkload" and one.name):
        pods = [
            (one, *found) for one in others if workload.together(one) and (found := gated_pods.pod(one)) is not None
        ]
        muxes = [pod for pod in pods if mux_container.path(pod[2], names.mux(workload.name))]
        if not gated_pods.gate(workload).is_at_robot:
            yield from _never_needed(workload, muxes)
            continue
        for manifest, path, spec in muxes:
            where = f"{path}.{mux_container.path(spec, names.mux(workload.name))}"
            for message in mux_container.problems(spec, workload.name):
                yield manifest.finding(where, message, warning=True)
            if message := mux_container.forgotten(spec, workload.name):
                yield manifest.finding(f"{path}.volumes", message, warning=True)
            yield from _several(manifest)
        if not muxes and any(mux_container.path(spec, names.robot_env(workload.name)) for _, _, spec in pods):
            message = (
                f"processes of the robot are in the given files, but no container has the environment of ConfigMap "
                f"{names.mux(workload.name)}. Without a mux (docs/mux.md), nothing that the instances send reaches the robot"
            )
            yield workload.finding("spec.gate.kind", message, warning=True)
        yield from _without_effect(workload)
        yield from _beside(workload, ours)


def _never_needed(workload: Manifest, muxes: Sequence[tuple[Manifest, str, Any]]) -> Iterator[Finding]:
    for manifest, path, spec in muxes:
        where = f"{path}.{mux_container.path(spec, names.mux(workload.name))}.envFrom"
        message = (
            f"RobotWorkload {workload.name} has gate kind {gated_pods.gate(workload).kind}, so nobody writes ConfigMap "
            f"{names.mux(workload.name)}, and the pod does not start: set spec.gate.kind of the workload, or remove the container"
        )
        yield manifest.finding(where, message, warning=True)


def _several(manifest: Manifest) -> Iterator[Finding]:
    """Report a controller that runs two muxes at the same time."""
    spec = at(manifest.data, "spec")
    replicas = at(spec, "replicas")
    if isinstance(replicas, int) and replicas > 1:
        message = f"each order names one mux, and the others of these {replicas} forward nothing: use 1"
        yield manifest.finding("spec.replicas", message, warning=True)
    elif manifest.kind == "Deployment" and at(spec, "strategy", "type") != "Recreate":
        message = "an update starts the new mux beside the old one, and two that share a volume both forward: use type Recreate"
        yield manifest.finding("spec.strategy", message, warning=True)


def _without_effect(workload: Manifest) -> Iterator[Finding]:
    """Report fields that only matter for gates in the network."""
    for number, output in enumerate(items(workload.data, "spec", "outputs")):
        if at(output, "lifespan") is not None:
            message = "has no effect with a mux, which never forwards what an instance sent before it was in control; remove it"
            yield workload.finding(f"spec.outputs[{number}].lifespan", message, warning=True)
    if items(workload.data, "spec", "gate", "reflex", "accept"):
        message = "has no effect with a mux, which switches all outputs at once; remove it"
        yield workload.finding("spec.gate.reflex.accept", message, warning=True)


def _beside(workload: Manifest, ours: Sequence[Manifest]) -> Iterator[Finding]:
    """Report pools whose pods would reach the robot beside the mux, because a container has DDS profiles of its own."""
    for pool in _pools(workload, ours):
        for number, container in enumerate(items(pool.data, "spec", "template", "spec", "containers")):
            if any(at(one, "name") == MIDDLEWARE.settings_variable for one in items(container, "env")):
                message = (
                    f"sets {MIDDLEWARE.settings_variable}, so the writers of this container are in no partition, and reach the robot of "
                    f"RobotWorkload {workload.name} beside its mux. Remove the variable"
                )
                yield pool.finding(f"spec.template.spec.containers[{number}].env", message, warning=True)


def _pools(workload: Manifest, ours: Sequence[Manifest]) -> list[Manifest]:
    """Return the pools of the workload's policy that are among the given objects."""
    name = at(workload.data, "spec", "failurePolicyRef", "name")
    near = [one for one in ours if workload.together(one)]
    policies = [one for one in near if (one.kind, one.name) == ("FailurePolicy", name)]
    used = [at(one, "poolRef", "name") for policy in policies for one in items(policy.data, "spec", "strategies")]
    return [one for one in near if one.kind == "FallbackPool" and one.name and one.name in used]
