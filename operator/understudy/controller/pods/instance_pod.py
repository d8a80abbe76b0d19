"""Pods that run a workload's application, made from the user's pod template.

Each gets labels that the gate selects by, the ROS environment of its robot, and the agent as a sidecar. A held pod's
containers wait for the claim instead of running.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.api import names
from understudy.api.protocol import freeze_script, hold_script
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Images, pull_secrets
from understudy.controller.pods import pod_placement, ros_environment, template_shape
from understudy.kube import claims
from understudy.kube.apply import digest
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind

AGENT_REQUESTS = {"cpu": "20m", "memory": "64Mi"}

HARDENED: Object = {
    "runAsNonRoot": True,
    "runAsUser": 65532,
    "runAsGroup": 65532,
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
    "seccompProfile": {"type": "RuntimeDefault"},
}
"""Security context of our own containers."""

DEFAULT_CONTAINER = "kubectl.kubernetes.io/default-container"
"""Annotation of a pod: whose logs kubectl shows unless it is told otherwise."""

_TOKEN_VOLUME = "understudy-agent-token"


@dataclass(frozen=True)
class Recipe:
    """What is made of a template."""

    workload: str
    """RobotWorkload of the instances; empty for the held pods of a shared pool."""
    namespace: str
    images: Images
    secret: str
    """Secret with the agents' token."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """ROS environment of the robot's graph; empty for held pods, which get it with the claim."""
    pool: str = ""
    held: bool = False
    warm_paths: Sequence[str] = ()
    stripped: frozenset[str] = frozenset()
    """Label keys that must not be carried: a referred controller would adopt the pods."""
    profiles: str = ""
    """DDS profiles of its processes, which are in the workload's ConfigMap; empty where they need none."""
    procedure: str = ""
    """What brings a standby to its pool's readiness, as text. Another one makes other pods, so that the old ones wait as they
    are until one that the new one has brought up is ready."""

    @property
    def prepared(self) -> bool:
        """Whether the profiles hold what only the pod itself can put in, before its processes start."""
        return names.STRENGTH_VARIABLE in self.profiles

    @property
    def fenced(self) -> bool:
        """Whether the agent can hold its application while the pod is cut off: where the robot's readers choose by strength."""
        return self.prepared and not self.held

    @property
    def profiles_file(self) -> str:
        """Where the pod's processes find their profiles."""
        return f"{names.AGENT_DIR if self.prepared else names.INSTANCE_PROFILES_DIR}/{names.PROFILES_KEY}"

    @property
    def variables(self) -> dict[str, str]:
        """The literal environment of the pod's processes."""
        profiles = {names.PROFILES_VARIABLE: self.profiles_file} if self.profiles else {}
        return {**(self.environment or ros_environment.COMMON), **profiles}


def problem(template: Mapping[str, Any], *, held: bool, path: str, gate: GateKind = registry.DEFAULT) -> str | None:
    """Why no instance can be made from a template, beyond what the API server says itself; None if one can.

    ``path`` is where the template stands, such as ``spec.template``; ``gate`` is the kind of the workload's gate.
    """
    if words := template_shape.problem(template, path):
        return words
    spec = template.get("spec") or {}
    if words := gate.ungateable(spec):
        return f"{path}.spec.{words}"
    containers = spec.get("containers") or []
    if not containers:
        return f"{path}.spec.containers is empty: give at least one container"
    for index, container in enumerate(containers):
        at = f"{path}.spec.containers[{index}]"
        if (taken := container.get("name")) in (names.AGENT_CONTAINER, names.INIT_CONTAINER):
            return f"{at}.name is {taken}, which the sidecar uses. Choose another name"
        for port in container.get("ports") or []:
            if port.get("containerPort") in (names.AGENT_PORT, names.AGENT_HEALTH_PORT):
                return f"{at} uses port {port['containerPort']}, which the sidecar uses. Choose another port"
        if held and not container.get("command"):
            return (
                f"{at} ({container.get('name')}) has no command. The container is held until a claim and then started, so the "
                f"command must be in the template (the entry point of the image is not known here)"
            )
    for volume in spec.get("volumes") or []:
        if volume.get("name") in (names.AGENT_VOLUME, _TOKEN_VOLUME, names.INSTANCE_PROFILES_VOLUME):
            return f"{path}.spec.volumes has {volume['name']}, which the sidecar uses. Choose another name"
    return None


def own_profiles(template: Mapping[str, Any]) -> list[str]:
    """The containers that name DDS profiles of their own, which then count instead of ours."""
    return [
        container["name"]
        for container in (template.get("spec") or {}).get("containers") or []
        if any(entry.get("name") == names.PROFILES_VARIABLE for entry in container.get("env") or [])
    ]


def build(template: Mapping[str, Any], recipe: Recipe) -> Object:
    """The pod template of an instance: ``metadata`` (labels, annotations) and ``spec``, without what names one pod."""
    spec = copy.deepcopy(dict(template.get("spec") or {}))
    held_names = [c["name"] for c in spec["containers"]] if recipe.held else []
    fenced_names = [c["name"] for c in spec["containers"] if c.get("command")] if recipe.fenced else []
    scope: freeze_script.Scope = "own" if spec.get("shareProcessNamespace") or spec.get("hostPID") else "all"
    spec["containers"] = [
        _fenced(_container(container, recipe, scope), scope)
        if container["name"] in fenced_names
        else _container(container, recipe, scope)
        for container in spec["containers"]
    ]
    everyone = [c["name"] for c in [*spec["containers"], *filter(_accompanies, spec.get("initContainers") or [])]]
    unfenced = [name for name in everyone if name not in fenced_names] if recipe.fenced else []
    if not recipe.held and spec.get("initContainers"):
        spec["initContainers"] = [
            _container(c, recipe, scope) if _accompanies(c) else c for c in spec["initContainers"]
        ]
    spec["containers"].append(_agent(recipe, held_names, fenced_names, unfenced))
    spec["volumes"] = [
        *(spec.get("volumes") or []),
        {"name": names.AGENT_VOLUME, "emptyDir": {}},
        {"name": _TOKEN_VOLUME, "secret": {"secretName": recipe.secret, "defaultMode": 0o444}},
    ]
    if recipe.profiles:
        config_map = {"name": names.instance_profiles(recipe.workload)}
        spec["volumes"].append({"name": names.INSTANCE_PROFILES_VOLUME, "configMap": config_map})
    if recipe.prepared:
        spec["initContainers"] = [_prepare(recipe, fenced_names), *(spec.get("initContainers") or [])]
    spec |= pull_secrets(recipe.images.pull_secrets, spec.get("imagePullSecrets") or [])
    pod_placement.keep_apart(spec, workload=recipe.workload, pool=recipe.pool, held=recipe.held)
    pod_placement.leave_lost_nodes(spec)
    found = template.get("metadata") or {}
    labels = {key: value for key, value in (found.get("labels") or {}).items() if key not in recipe.stripped}
    labels |= _labels(recipe)
    metadata: Object = {"labels": labels}
    if found.get("annotations"):
        metadata["annotations"] = dict(found["annotations"])
    if recipe.profiles:
        # A process that has read the profiles must start anew to read others.
        metadata.setdefault("annotations", {})[names.PROFILES_HASH] = digest(recipe.profiles)
    if recipe.procedure:
        metadata.setdefault("annotations", {})[names.PROCEDURE_HASH] = digest(recipe.procedure)
    built: Object = {"metadata": metadata, "spec": spec}
    labels[names.TEMPLATE_HASH] = digest(built)
    return built


def _accompanies(container: Mapping[str, Any]) -> bool:
    """Whether an init container runs beside the application (KEP-753). In a held pod it begins before anybody knows for which robot."""
    return container.get("restartPolicy") == "Always"


def _labels(recipe: Recipe) -> dict[str, str]:
    labels = {names.COMPONENT: "instance"}
    if recipe.workload:
        labels[names.WORKLOAD] = recipe.workload
    if recipe.pool:
        labels[names.POOL] = recipe.pool
    if recipe.held:
        labels[names.HELD] = "true"
    if not recipe.pool:
        labels[names.SOURCE] = "workload"
    return labels


def template_hash(built: Object) -> str:
    """The hash of a built template, which its pods carry as a label."""
    found: str = built["metadata"]["labels"][names.TEMPLATE_HASH]
    return found


def pod(built: Object, *, name: str, namespace: str, owner: Object) -> Object:
    """A pod of a built template."""
    metadata = built["metadata"]
    labels = {**metadata["labels"], names.INSTANCE: name}
    annotations = dict(metadata.get("annotations") or {})
    if names.HELD in labels:
        labels[names.PART] = claims.part(name)
        # A claim adds to the annotations, so there must be one.
        annotations.setdefault(DEFAULT_CONTAINER, built["spec"]["containers"][0]["name"])
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            **metadata,
            "name": name,
            "namespace": namespace,
            "labels": labels,
            **({"annotations": annotations} if annotations else {}),
            "ownerReferences": [owner],
        },
        "spec": built["spec"],
    }


def trial(built: Object, kind: str, item: Object) -> Object:
    """A pod by which the API server can judge the template of an object of ours; it is only ever sent as a dry run."""
    name, namespace = f"{kube_objects.name(item)}-check", item["metadata"]["namespace"]
    return pod(built, name=name, namespace=namespace, owner=kube_objects.owner(kind, item))


def replica_set(built: Object, workload: str) -> Object:
    """The ReplicaSet that a workload's template becomes. It replaces a deleted pod while the operator is down.

    ``replicas`` isn't given: it begins at one, and is then changed only through the scale subresource.
    """
    selector = {names.WORKLOAD: workload, names.COMPONENT: "instance", names.SOURCE: "workload"}
    return {
        "apiVersion": "apps/v1",
        "kind": "ReplicaSet",
        "metadata": {"name": workload, "labels": {names.COMPONENT: "instance"}},
        "spec": {"selector": {"matchLabels": selector}, "template": built},
    }


def literal_environment(template: Mapping[str, Any], ros: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Per container, the environment that a claimed pod is started with: ROS, and the template's literals over it.

    Values that refer to others (``$(NAME)``) or to objects (``valueFrom``) are the kubelet's to resolve and stay as
    the pool's own template has them.
    """
    return {
        container["name"]: {
            **ros,
            **{
                entry["name"]: entry.get("value") or ""
                for entry in container.get("env") or []
                if not entry.get("valueFrom") and "$(" not in (entry.get("value") or "")
            },
        }
        for container in (template.get("spec") or {}).get("containers") or []
    }


def _container(container: Object, recipe: Recipe, scope: freeze_script.Scope) -> Object:
    given = {entry["name"] for entry in container.get("env") or []}
    added = [entry for entry in _plain(recipe.variables) if entry["name"] not in given]
    made = {**container, "env": [*(container.get("env") or []), *added]}
    if recipe.profiles:
        if names.POD_VARIABLE not in given:
            made["env"].append(_field(names.POD_VARIABLE, "metadata.name"))
        made["volumeMounts"] = [*(container.get("volumeMounts") or []), _profiles_mount(recipe)]
    return _held(made, recipe, scope) if recipe.held else made


def _profiles_mount(recipe: Recipe) -> Object:
    volume, folder = (
        (names.AGENT_VOLUME, names.AGENT_DIR)
        if recipe.prepared
        else (names.INSTANCE_PROFILES_VOLUME, names.INSTANCE_PROFILES_DIR)
    )
    return {"name": volume, "mountPath": folder, "readOnly": True}


def _prepare(recipe: Recipe, fenced: Sequence[str]) -> Object:
    """The init container that fills in the profiles, before the application's own ones."""
    fences = _plain({names.FENCED_VARIABLE: " ".join(fenced)}) if fenced else []
    return {
        "name": names.INIT_CONTAINER,
        "image": recipe.images.monitor,
        "imagePullPolicy": recipe.images.pull_policy,
        "args": ["prepare"],
        "env": [*fences, _field(names.POD_VARIABLE, "metadata.name")],
        "resources": {"requests": dict(AGENT_REQUESTS)},
        "securityContext": copy.deepcopy(HARDENED),
        "volumeMounts": [
            {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR},
            {"name": names.INSTANCE_PROFILES_VOLUME, "mountPath": names.INSTANCE_PROFILES_DIR, "readOnly": True},
        ],
    }


def _held(container: Object, recipe: Recipe, scope: freeze_script.Scope) -> Object:
    """The container waits; its probes would kill it for that, and its hook would wait for a process that isn't.

    Whether its robot needs it to be held when it's cut off is known with the claim only: the script finds out.
    """
    made = {k: v for k, v in container.items() if k not in ("livenessProbe", "readinessProbe", "startupProbe")}
    if hooks := {k: v for k, v in (container.get("lifecycle") or {}).items() if k != "postStart"}:
        made["lifecycle"] = hooks
    else:
        made.pop("lifecycle", None)
    command = freeze_script.fenced_command(
        container["name"], container["command"], container.get("args") or [], scope=scope
    )
    made["command"] = hold_script.held_command(container["name"], command, [], recipe.warm_paths)
    made.pop("args", None)
    made["volumeMounts"] = [
        *(container.get("volumeMounts") or []),
        {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR},
    ]
    return made


def _fenced(container: Object, scope: freeze_script.Scope) -> Object:
    """The container's command is begun by a script through which the agent can hold it."""
    made = {key: value for key, value in container.items() if key != "args"}
    made["command"] = freeze_script.fenced_command(
        container["name"], container["command"], container.get("args") or [], scope=scope
    )
    return made


def _plain(environment: Mapping[str, str]) -> list[Object]:
    return [{"name": key, "value": value} for key, value in sorted(environment.items())]


def _field(name: str, path: str) -> Object:
    return {"name": name, "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": path}}}


def _agent(recipe: Recipe, held: Sequence[str], fenced: Sequence[str], unfenced: Sequence[str]) -> Object:
    fences = {names.FENCED_VARIABLE: " ".join(fenced), names.UNFENCED_VARIABLE: " ".join(unfenced)}
    fixed = {
        **{key: value for key, value in fences.items() if value},
        "UNDERSTUDY_WORKLOAD": recipe.workload,
        "UNDERSTUDY_NAMESPACE": recipe.namespace,
        "UNDERSTUDY_HELD_CONTAINERS": " ".join(held),
        "HOME": names.AGENT_DIR,
        "ROS_LOG_DIR": f"{names.AGENT_DIR}/log",
        **ros_environment.introspecting(recipe.variables),
    }
    profiles = [_profiles_mount(recipe)] if recipe.profiles and not recipe.prepared else []
    return {
        "name": names.AGENT_CONTAINER,
        "image": recipe.images.monitor,
        "imagePullPolicy": recipe.images.pull_policy,
        "args": ["agent"],
        "env": [
            *_plain(fixed),
            _field("UNDERSTUDY_POD", "metadata.name"),
            _field("UNDERSTUDY_POD_UID", "metadata.uid"),
            _field("UNDERSTUDY_POD_IP", "status.podIP"),
        ],
        "ports": [
            {"name": "us-agent", "containerPort": names.AGENT_PORT, "protocol": "TCP"},
            {"name": "us-health", "containerPort": names.AGENT_HEALTH_PORT, "protocol": "TCP"},
        ],
        "readinessProbe": {
            "httpGet": {"path": "/ready", "port": names.AGENT_HEALTH_PORT},
            "periodSeconds": 1,
            "timeoutSeconds": 1,
            "failureThreshold": 2,
        },
        "resources": {"requests": dict(AGENT_REQUESTS)},
        "securityContext": copy.deepcopy(HARDENED),
        "volumeMounts": [
            {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR},
            {"name": _TOKEN_VOLUME, "mountPath": names.SECRET_DIR, "readOnly": True},
            *profiles,
        ],
    }
