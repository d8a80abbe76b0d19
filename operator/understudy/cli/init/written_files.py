"""Decides what the manifests of an application are, and writes them with the reason for each choice. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import yaml

from understudy.api import names
from understudy.api.kinds.robot_workload import Ros
from understudy.cli.init.application import Application, lacking
from understudy.cli.manifests import placeholders
from understudy.controller.pods.ros_environment import PROFILES_DIR
from understudy.ros.rmw import MIDDLEWARE

GateKind = Literal["NetworkPolicy", "Mux"]
Readiness = Literal["Executing", "Uninitialized"]

OBJECTS, APPLICATION_PATCH, ROBOT_PATCH = "understudy.yaml", "patches/application.yaml", "patches/robot.yaml"

GAP = "500ms"
"""The gap of an output that was not measured."""

_REPLACE_ROBOT = f" Replace {placeholders.ROBOT} and {placeholders.CONTAINER} by what runs them, or give --robot."

_VARIABLES = tuple(MIDDLEWARE.environment(Ros(), "a managed server"))
"""The variables with which a process joins a robot's ROS graph."""


@dataclass(frozen=True)
class Draft:
    """What was decided."""

    name: str
    namespace: str
    """Empty: that of the context in which the files are applied."""
    application: Application
    robot: Application | None
    outputs: Sequence[tuple[str, str]]
    """Topics and their types."""
    leaves: Sequence[Sequence[str]]
    """The lines of each leaf of the health tree, with comments."""
    gate: GateKind
    readiness: Readiness
    image: str
    """The image of the mux; empty if it is not known, or if there is no mux."""
    source: str
    """What the bounds were learned from; empty if nothing was measured."""

    @property
    def domain(self) -> int:
        """The ROS domain of the application."""
        text = self.application.environment.get("ROS_DOMAIN_ID", "")
        return int(text) if text.isdigit() else 0

    @property
    def discovery_server(self) -> str:
        """The discovery server that the application uses already; empty if it uses none."""
        return MIDDLEWARE.discovery_server(self.application.environment)


def files(draft: Draft) -> dict[str, str]:
    """Return the text of each file by its path below the folder."""
    written = {OBJECTS: "\n---\n".join("\n".join(part) for part in (_workload(draft), _policy(draft), _pool(draft)))}
    if draft.gate != "Mux" and any(lacking(one, _VARIABLES) for one in draft.application.containers):
        written[APPLICATION_PATCH] = "\n".join(_application_patch(draft))
    written[ROBOT_PATCH] = "\n".join(_mux_patch(draft) if draft.gate == "Mux" else _profile_patch(draft))
    return {path: f"{text}\n" for path, text in written.items()}


def next_steps(draft: Draft, folder: str, written: Collection[str]) -> list[str]:
    """Return the commands that follow, in order, for the files with these paths."""
    there = f" -n {draft.namespace}" if draft.namespace else ""
    application, robot = draft.application, draft.robot
    steps = [f"understudy check -R {folder}", f"kubectl apply{there} -f {folder}"]
    own = f"{application.kind.lower()} {application.name}"
    if draft.gate == "Mux":
        steps.insert(1, f"kubectl scale{there} {own} --replicas=0")
    elif APPLICATION_PATCH in written:
        steps.append(f"kubectl patch{there} {own} --patch-file {folder}/{APPLICATION_PATCH}")
    target = f"{robot.kind.lower()} {robot.name}" if robot else f"deployment {placeholders.ROBOT}"
    steps.append(f"kubectl patch{there} {target} --patch-file {folder}/{ROBOT_PATCH}")
    steps.append(f"kubectl wait{there} --for=condition=Ready robotworkload/{draft.name} --timeout=5m")
    return steps


def _head(draft: Draft, kind: str, name: str, labels: str = "") -> Iterator[str]:
    where = f", namespace: {draft.namespace}" if draft.namespace else ""
    yield "apiVersion: understudy.dev/v1alpha1"
    yield f"kind: {kind}"
    yield f"metadata: {{name: {name}{where}{labels}}}"
    yield "spec:"


def _workload(draft: Draft) -> Iterator[str]:
    application = draft.application
    yield "# What drives the robot, and everything with which it acts on the robot."
    yield from _head(draft, "RobotWorkload", draft.name, f", labels: {{app: {draft.name}}}")
    if draft.gate == "Mux":
        yield f"  # From {application.kind} {application.name}, which must not run any more: only pods that Understudy creates have the"
        yield "  # DDS profiles that a mux needs."
        yield "  template:"
        dumped = yaml.safe_dump(application.template, sort_keys=False, width=120)
        yield from (f"    {line}" for line in dumped.splitlines())
    else:
        yield f"  # Understudy does not change the {application.kind}. It labels its pods."
        yield f"  workloadRef: {{kind: {application.kind}, name: {application.name}}}"
    if draft.discovery_server:
        yield "  # The discovery server that the application uses already."
        yield f"  ros: {{domainId: {draft.domain}, discovery: {{mode: External, server: {draft.discovery_server!r}}}}}"
    else:
        yield "  # Understudy runs a discovery server for this robot: pod networks rarely forward multicast."
        yield f"  ros: {{domainId: {draft.domain}}}"
    yield "  # Also list the services and actions between the application and the robot. What is not listed is not gated."
    yield "  outputs:"
    yield from (f"    - {{topic: {topic}, type: {type_name}}}" for topic, type_name in draft.outputs)
    if draft.gate == "Mux":
        yield "  # A process at the robot forwards one instance. It needs nothing of the network."
        yield "  gate: {kind: Mux}"
    else:
        yield "  # The gate is a NetworkPolicy (the default): `understudy doctor` shows whether the network enforces it."
    yield f"  failurePolicyRef: {{name: {draft.name}}}"


def _policy(draft: Draft) -> Iterator[str]:
    yield "# What healthy means, and what to do otherwise."
    yield from _head(draft, "FailurePolicy", draft.name)
    yield "  monitoring:"
    yield "    yaml:"
    if draft.source:
        yield f"      # Bounds learned from {draft.source}. Was the robot healthy and driving all the time?"
        yield "      # An output that is silent while there is nothing to do must not have a gap."
    yield "      parallel:                               # all of it must hold"
    for leaf in draft.leaves:
        yield from (f"        {line}" for line in leaf)
    yield "  strategies:                                 # in this order"
    within = "3s" if draft.readiness == "Executing" else "60s"
    yield f"    - {{type: Fallback, poolRef: {{name: {draft.name}}}, verifyWithin: {within}}}"
    yield "    - {type: Restart, verifyWithin: 60s}      # if there is no understudy"


def _pool(draft: Draft) -> Iterator[str]:
    if draft.readiness == "Executing":
        yield "# A second instance runs in full, its outputs gated: the shortest gap, for the application's CPU and memory once more."
        yield from _head(draft, "FallbackPool", draft.name)
        yield "  readiness: Executing"
        yield "  perWorkload: 1"
    else:
        yield "# A pod waits with its image unpacked, and starts its processes at a failure: a gap of seconds, for almost no CPU."
        yield from _head(draft, "FallbackPool", draft.name)
        yield "  readiness: Uninitialized"
        yield "  replicas: 1                                 # for all workloads that the selector selects"
        yield f"  templateFrom: {{workload: {draft.name}}}"
    yield f"  workloadSelector: {{matchLabels: {{app: {draft.name}}}}}"


def _patch_head(application: Application | None, why: str, target: str, *, alone: bool = False) -> Iterator[str]:
    """Yield the beginning of a patch up to its containers; with ``alone``, no two pods of a Deployment run at once."""
    yield f"# {why}"
    yield "apiVersion: apps/v1"
    yield f"kind: {application.kind if application else 'Deployment'}"
    yield f"metadata: {{name: {application.name if application else target}}}"
    yield "spec:"
    if alone and (application is None or application.kind == "Deployment"):
        yield "  strategy: {type: Recreate, rollingUpdate: null}     # never two muxes"
    yield "  template:"
    yield "    spec:"
    yield "      containers:"


def _application_patch(draft: Draft) -> Iterator[str]:
    application = draft.application
    config_map = names.robot_env(draft.name)
    yield from _patch_head(application, "The application joins the robot's ROS graph.", "")
    for container in application.containers:
        missing = lacking(container, _VARIABLES)
        if not missing:
            continue
        yield f"        - name: {container['name']}"
        yield "          env:"
        for name in missing:
            if name in MIDDLEWARE.common:
                yield f"            - {{name: {name}, value: {MIDDLEWARE.common[name]}}}"
            else:
                key = f"{{configMapKeyRef: {{name: {config_map}, key: {name}}}}}"
                yield f"            - {{name: {name}, valueFrom: {key}}}"


def _robot_containers(draft: Draft) -> list[str]:
    robot = draft.robot
    return [str(one["name"]) for one in robot.containers] if robot else [placeholders.CONTAINER]


def _profile_patch(draft: Draft) -> Iterator[str]:
    why = "The robot's processes that read an output do so at ports that the gate controls."
    if draft.robot is None:
        why += _REPLACE_ROBOT
    yield from _patch_head(draft.robot, why, placeholders.ROBOT)
    for container in _robot_containers(draft):
        yield f"        - name: {container}"
        yield "          envFrom:"
        yield f"            - configMapRef: {{name: {names.robot_env(draft.name)}}}"
        yield "          volumeMounts:"
        yield f"            - {{name: understudy, mountPath: {PROFILES_DIR}, readOnly: true}}"
    yield "      volumes:"
    yield f"        - {{name: understudy, configMap: {{name: {names.robot_profiles(draft.name)}}}}}"


def _mux_patch(draft: Draft) -> Iterator[str]:
    why = "The robot's processes join the graph, and a mux beside them forwards one instance."
    if not draft.image:
        why += f" Replace {placeholders.IMAGE} by the image of the monitor, or give --image."
    if draft.robot is None:
        why += _REPLACE_ROBOT
    yield from _patch_head(draft.robot, why, placeholders.ROBOT, alone=True)
    for container in _robot_containers(draft):
        yield f"        - name: {container}"
        yield "          envFrom:"
        yield f"            - configMapRef: {{name: {names.robot_env(draft.name)}}}"
    mux = names.mux(draft.name)
    yield "        - name: understudy-mux"
    yield f"          image: {draft.image or placeholders.IMAGE}     # that of the monitor: the chart's value images.monitor"
    yield "          args: [mux]"
    yield "          envFrom:"
    yield f"            - configMapRef: {{name: {names.robot_env(draft.name)}}}"
    yield f"            - configMapRef: {{name: {mux}}}"
    yield "          volumeMounts:"
    yield f"            - {{name: understudy-mux, mountPath: {names.MUX_FOLDER}, readOnly: true}}"
    yield f"            - {{name: understudy-mux-state, mountPath: {names.STATE_DIR}}}"
    yield "      volumes:"
    yield f"        - {{name: understudy-mux, secret: {{secretName: {mux}}}}}"
    yield "        - {name: understudy-mux-state, emptyDir: {sizeLimit: 16Mi}}"
