"""Pods that run a workload's application, built from the user's pod template.

Each pod receives the labels that the gate selects, the ROS environment of its robot, and the agent as a sidecar. The
containers of a held pod wait for the claim.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.api import names
from understudy.api.protocol import freeze_script, hold_script
from understudy.api.protocol.agent_messages import KEYED_PROTOCOL, OLDEST_PROTOCOL, PROTOCOL
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Images, from_field, pull_secrets, resources, variables
from understudy.controller.pods import pod_placement, template_shape
from understudy.kube import claims
from understudy.kube.apply import digest
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind
from understudy.ros.rmw import MIDDLEWARE

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
"""Security context of Understudy's own containers."""

_VOLUMES = (names.AGENT_VOLUME, names.MEMORY_VOLUME, names.TOKEN_VOLUME, names.INSTANCE_PROFILES_VOLUME)

DEFAULT_CONTAINER = "kubectl.kubernetes.io/default-container"
"""Annotation of a pod with the container whose logs kubectl shows by default."""


@dataclass(frozen=True)
class Recipe:
    """How to build pods from a template."""

    workload: str
    """RobotWorkload of the instances; empty for the held pods of a shared pool."""
    namespace: str
    images: Images
    secret: str
    """Secret with the agents' token."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """ROS environment of the robot's graph; empty for held pods, which receive it with the claim."""
    pool: str = ""
    held: bool = False
    warm_paths: Sequence[str] = ()
    preload: Sequence[str] = ()
    stripped: frozenset[str] = frozenset()
    """Label keys that the pods must not have, because a referred controller would adopt the pods."""
    profiles: str = ""
    """DDS profiles of its processes, from the workload's ConfigMap; empty if they need none."""
    procedure: str = ""
    """The procedure that brings a standby to its pool's readiness, as text.

    Another procedure results in other pods. So the old ones stay unchanged until a pod that was initialized with the
    new procedure is ready.
    """

    agent_protocol: int = PROTOCOL
    """Version of the protocol that the agent in ``images`` knows at least."""

    @property
    def prepared(self) -> bool:
        """Whether the profiles contain values that only the pod itself can fill in, before its processes start."""
        return names.STRENGTH_VARIABLE in self.profiles

    @property
    def fenced(self) -> bool:
        """Whether the agent can freeze the application of an isolated pod, for robots whose readers select by strength."""
        return self.prepared and not self.held

    @property
    def profiles_file(self) -> str:
        """The path of the profiles for the pod's processes."""
        return f"{names.AGENT_DIR if self.prepared else names.INSTANCE_PROFILES_DIR}/{names.PROFILES_KEY}"

    @property
    def variables(self) -> dict[str, str]:
        """The literal environment of the pod's processes."""
        profiles = {MIDDLEWARE.settings_variable: self.profiles_file} if self.profiles else {}
        return {**(self.environment or MIDDLEWARE.common), **profiles}


def problem(template: Mapping[str, Any], *, held: bool, path: str, gate: GateKind = registry.DEFAULT) -> str | None:
    """Return why no instance can be built from a template, except for what the API server reports itself, or None.

    ``path`` is the location of the template, such as ``spec.template``. ``gate`` is the kind of the workload's gate.
    """
    if words := template_shape.problem(template, path):
        return words
    if words := gate.ungateable(template):
        return f"{path}.{words}"
    spec = template.get("spec") or {}
    containers = spec.get("containers") or []
    if not containers:
        return f"{path}.spec.containers is empty: give at least one container"
    for index, container in enumerate(containers):
        at = f"{path}.spec.containers[{index}]"
        if (taken := container.get("name")) in (names.AGENT_CONTAINER, names.INIT_CONTAINER):
            return f"{at}.name is {taken}, which Understudy's sidecar uses. Choose another name"
        for port in container.get("ports") or []:
            if port.get("containerPort") in (names.AGENT_PORT, names.AGENT_HEALTH_PORT):
                return f"{at} uses port {port['containerPort']}, which Understudy's sidecar uses. Choose another port"
        if held and not container.get("command"):
            return (
                f"{at} ({container.get('name')}) has no command. The container starts only when a workload claims the pod, so Understudy "
                "must know its command. Set command in the template (the entry point of the image cannot be used)"
            )
    for volume in spec.get("volumes") or []:
        if volume.get("name") in _VOLUMES:
            return f"{path}.spec.volumes has {volume['name']}, which Understudy's sidecar uses. Choose another name"
    return _mounts_problem(spec, f"{path}.spec")


def preloads(template: Mapping[str, Any]) -> bool:
    """Return whether the command of a container of a template is one for which modules can be preloaded."""
    containers = (template.get("spec") or {}).get("containers") or []
    return any(hold_script.preloads(container.get("command") or []) for container in containers)


def _mounts_problem(spec: Mapping[str, Any], at: str) -> str | None:
    """Return which container mounts a volume of the agent, which ``build`` adds to the pod later; None if none does."""
    for containers in ("containers", "initContainers"):
        for number, container in enumerate(spec.get(containers) or []):
            for field_name in ("volumeMounts", "volumeDevices"):
                for index, mount in enumerate(container.get(field_name) or []):
                    if mount.get("name") in _VOLUMES:
                        return (
                            f"{at}.{containers}[{number}].{field_name}[{index}] names {mount['name']}, a volume of Understudy's sidecar, "
                            "which mounts it itself where the application needs it. Remove the entry, or mount a volume of your own"
                        )
    return None


def agent_protocol(image: str, workloads: Iterable[Object]) -> int:
    """Return the version of the protocol that the agent in an image knows at least.

    That is the operator's own version, unless a monitor of one of these workloads runs the image and does not report a version: an image
    of the user's own stays as it was when Understudy is upgraded.
    """
    return OLDEST_PROTOCOL if any(_has_older_monitor(workload, image) for workload in workloads) else PROTOCOL


def _has_older_monitor(workload: Object, image: str) -> bool:
    status = workload.get("status") or {}
    if monitor := status.get("monitor"):
        return bool(monitor.get("image") == image and not monitor.get("agentProtocol"))
    # A monitor before 0.2.0 does not report its image, but a health.
    own = ((workload.get("spec") or {}).get("monitor") or {}).get("image")
    return "health" in status and own == image


def own_profiles(template: Mapping[str, Any]) -> list[str]:
    """Return the containers that set their own DDS profiles, which then replace those of Understudy."""
    return [
        container["name"]
        for container in (template.get("spec") or {}).get("containers") or []
        if any(entry.get("name") == MIDDLEWARE.settings_variable for entry in container.get("env") or [])
    ]


def build(template: Mapping[str, Any], recipe: Recipe) -> Object:
    """Return an instance's pod template: ``metadata`` (labels, annotations) and ``spec``, without the name of a pod."""
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
        {"name": names.MEMORY_VOLUME, "emptyDir": {}},
        {"name": names.TOKEN_VOLUME, "secret": _secret(recipe.secret)},
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
        # A process that has read the profiles must restart to read others.
        metadata.setdefault("annotations", {})[names.PROFILES_HASH] = digest(recipe.profiles)
    if recipe.procedure:
        metadata.setdefault("annotations", {})[names.PROCEDURE_HASH] = digest(recipe.procedure)
    built: Object = {"metadata": metadata, "spec": spec}
    labels[names.TEMPLATE_HASH] = digest(built)
    return built


def _accompanies(container: Mapping[str, Any]) -> bool:
    """Whether an init container runs beside the application (KEP-753).

    In a held pod, it starts before the robot is known.
    """
    return container.get("restartPolicy") == "Always"


def _labels(recipe: Recipe) -> dict[str, str]:
    labels = {names.COMPONENT: "instance"}
    if recipe.workload:
        labels[names.WORKLOAD] = recipe.workload
    if recipe.pool:
        labels[names.POOL] = recipe.pool
    if recipe.held:
        labels |= {names.HELD: "true", names.WORKLOAD: names.UNCLAIMED, names.CLAIMED_BY: names.UNCLAIMED}
    if not recipe.pool:
        labels[names.SOURCE] = "workload"
    return labels


def template_hash(built: Object) -> str:
    """Return the hash of a built template, which its pods have as a label."""
    found: str = built["metadata"]["labels"][names.TEMPLATE_HASH]
    return found


def pod(
    built: Object, *, name: str, namespace: str, owner: Object, annotations: Mapping[str, str] | None = None
) -> Object:
    """Return a pod of a built template, with further annotations."""
    metadata = built["metadata"]
    labels = {**metadata["labels"], names.INSTANCE: name}
    noted = {**(metadata.get("annotations") or {}), **(annotations or {})}
    if names.HELD in labels:
        labels[names.PART] = claims.part(name)
        # A claim adds to the annotations, so there must be one.
        noted.setdefault(DEFAULT_CONTAINER, built["spec"]["containers"][0]["name"])
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            **metadata,
            "name": name,
            "namespace": namespace,
            "labels": labels,
            **({"annotations": noted} if noted else {}),
            "ownerReferences": [owner],
        },
        "spec": _on_node(built["spec"], f"{namespace}/{name}"),
    }


def trial(built: Object, kind: str, item: Object) -> Object:
    """Return a pod with which the API server can validate an object's template. It is only sent as a dry run."""
    name, namespace = f"{kube_objects.name(item)}-check", item["metadata"]["namespace"]
    return pod(built, name=name, namespace=namespace, owner=kube_objects.owner(kind, item))


def replica_set(built: Object, workload: str, namespace: str) -> Object:
    """Return the ReplicaSet for a workload's template. It replaces a deleted pod while the operator is down.

    ``replicas`` is omitted: it starts at one, and then only the scale subresource changes it.
    """
    selector = {names.WORKLOAD: workload, names.COMPONENT: "instance", names.SOURCE: "workload"}
    template = {**built, "spec": _on_node(built["spec"], f"{namespace}/{workload}")}
    return {
        "apiVersion": "apps/v1",
        "kind": "ReplicaSet",
        "metadata": {"name": workload, "labels": {names.COMPONENT: "instance"}},
        "spec": {"selector": {"matchLabels": selector}, "template": template},
    }


def _on_node(spec: Object, name: str) -> Object:
    """Return the spec of a pod. In the network of its node, its agent has ports that depend on the pod's name.

    All pods in this network share its ports, so two agents there need different ones. Kubernetes counts the ports of a
    container as ports of the node then, and chooses another node if they are taken.
    """
    if not spec.get("hostNetwork"):
        return spec
    *others, agent = spec["containers"]
    taken = {port.get("containerPort") for container in others for port in container.get("ports") or []}
    pairs = names.NODE_AGENT_PORTS[::2]
    first = int(digest(name), 16) % len(pairs)
    control = next(port for port in [*pairs[first:], *pairs[:first]] if not taken & {port, port + 1})
    return {**spec, "containers": [*others, {**agent, **_listening(control, control + 1, agent["env"])}]}


def _listening(control: int, health: int, environment: Sequence[Object]) -> Object:
    """Return the fields of the agent's container that depend on its ports."""
    other = {
        names.AGENT_PORT_VARIABLE: (control, names.AGENT_PORT),
        names.AGENT_HEALTH_PORT_VARIABLE: (health, names.AGENT_HEALTH_PORT),
    }
    chosen = {key: str(port) for key, (port, usual) in other.items() if port != usual}
    return {
        "env": [*variables(chosen), *environment],
        "ports": [
            {"name": names.AGENT_PORT_NAME, "containerPort": control, "protocol": "TCP"},
            {"name": "us-health", "containerPort": health, "protocol": "TCP"},
        ],
        "readinessProbe": {
            "httpGet": {"path": "/ready", "port": health},
            "periodSeconds": 1,
            "timeoutSeconds": 1,
            "failureThreshold": 2,
        },
    }


def literal_environment(template: Mapping[str, Any], ros: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return the environment of a claimed pod for each container: ROS, overridden by the template's literals.

    Only the kubelet can resolve values that refer to others (``$(NAME)``) or to objects (``valueFrom``). These stay as
    in the pool's own template.
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
    names_set = {entry["name"] for entry in container.get("env") or []}
    added = [entry for entry in variables(recipe.variables) if entry["name"] not in names_set]
    made = {**container, "env": [*(container.get("env") or []), *added]}
    if recipe.profiles:
        if names.POD_VARIABLE not in names_set:
            made["env"].append(from_field(names.POD_VARIABLE, "metadata.name"))
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
    """Return the init container that completes the profiles, before the application's own init containers."""
    fences = variables({names.FENCED_VARIABLE: " ".join(fenced)}) if fenced else []
    return {
        "name": names.INIT_CONTAINER,
        "image": recipe.images.monitor,
        "imagePullPolicy": recipe.images.pull_policy,
        "args": ["prepare"],
        "env": [*fences, from_field(names.POD_VARIABLE, "metadata.name")],
        "resources": resources(AGENT_REQUESTS, recipe.images.memory_limit),
        "securityContext": copy.deepcopy(HARDENED),
        "volumeMounts": [
            {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR},
            {"name": names.INSTANCE_PROFILES_VOLUME, "mountPath": names.INSTANCE_PROFILES_DIR, "readOnly": True},
        ],
    }


def _held(container: Object, recipe: Recipe, scope: freeze_script.Scope) -> Object:
    """Return a container that waits for the claim.

    Its probes are removed, because they would kill it while it waits. Its postStart hook is removed, because it would
    wait for a process that does not exist. Only the claim shows whether the robot needs the application to be frozen
    while the pod is isolated, so the script determines that.
    """
    made = {k: v for k, v in container.items() if k not in ("livenessProbe", "readinessProbe", "startupProbe")}
    if hooks := {k: v for k, v in (container.get("lifecycle") or {}).items() if k != "postStart"}:
        made["lifecycle"] = hooks
    else:
        made.pop("lifecycle", None)
    name, own = container["name"], [*container["command"], *(container.get("args") or [])]
    command = freeze_script.fenced_command(name, own, [], scope=scope)
    preloading = ""
    if recipe.preload and hold_script.preloads(own):
        preloading = hold_script.preloading(name, own, recipe.preload, before=len(command) - len(own))
    made["command"] = hold_script.held_command(name, command, [], recipe.warm_paths, preloading=preloading)
    made.pop("args", None)
    made["volumeMounts"] = [
        *(container.get("volumeMounts") or []),
        {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR, "readOnly": True},
    ]
    return made


def _seen_waiting(container: str) -> Object:
    """Return a mount that makes an agent up to 0.1.0, from a user's own image, find that a held container waits.

    It asks for a file that such a container wrote beside the FIFO, before the volume was read-only for it. The FIFO alone is right too.
    """
    path = f"{names.AGENT_DIR}/{hold_script.waiting_name(container)}"
    return {"name": names.MEMORY_VOLUME, "mountPath": path, "subPath": "waiting"}


def _secret(name: str) -> Object:
    """Return what the agent's volume has of the Secret: all but the private key of the monitor.

    It is optional, because the public key comes later if the monitor is of an earlier version, and is missing after a rollback.
    """
    items = [{"key": entry, "path": entry} for entry in (names.TOKEN, names.MONITOR_PUBLIC_KEY)]
    return {"secretName": name, "items": items, "optional": True, "defaultMode": 0o444}


def knows_keys(workloads: Iterable[Object]) -> bool:
    """Whether the monitors of all these workloads know the version of the protocol in which agents recognize them by a key.

    One that has not reported anything yet is new, and has the image of this version or of a user.
    """
    return all(_knows_keys(workload.get("status") or {}) for workload in workloads)


def _knows_keys(status: Object) -> bool:
    if monitor := status.get("monitor"):
        return bool((monitor.get("agentProtocol") or 0) >= KEYED_PROTOCOL)
    return "health" not in status  # a monitor before 0.2.0 reports a health, and not itself


def _fenced(container: Object, scope: freeze_script.Scope) -> Object:
    """Return a container whose command is started by a script, through which the agent can freeze it."""
    made = {key: value for key, value in container.items() if key != "args"}
    made["command"] = freeze_script.fenced_command(
        container["name"], container["command"], container.get("args") or [], scope=scope
    )
    return made


def _agent(recipe: Recipe, held: Sequence[str], fenced: Sequence[str], unfenced: Sequence[str]) -> Object:
    fences = {names.FENCED_VARIABLE: " ".join(fenced), names.UNFENCED_VARIABLE: " ".join(unfenced)}
    fixed = {
        **{key: value for key, value in fences.items() if value},
        **(
            {names.AGENT_PROTOCOL_VARIABLE: str(recipe.agent_protocol)}
            if recipe.agent_protocol > OLDEST_PROTOCOL
            else {}
        ),
        names.WORKLOAD_VARIABLE: recipe.workload,
        "UNDERSTUDY_NAMESPACE": recipe.namespace,
        "UNDERSTUDY_HELD_CONTAINERS": " ".join(held),
        names.MEMORY_VARIABLE: names.MEMORY_DIR,
        "HOME": names.MEMORY_DIR,
        "ROS_LOG_DIR": f"{names.MEMORY_DIR}/log",
        **MIDDLEWARE.introspecting(recipe.variables),
    }
    environment = [
        *variables(fixed),
        from_field(names.POD_VARIABLE, "metadata.name"),
        from_field(names.POD_UID_VARIABLE, "metadata.uid"),
        from_field("UNDERSTUDY_POD_IP", "status.podIP"),
    ]
    profiles = [_profiles_mount(recipe)] if recipe.profiles and not recipe.prepared else []
    return {
        "name": names.AGENT_CONTAINER,
        "image": recipe.images.monitor,
        "imagePullPolicy": recipe.images.pull_policy,
        "args": ["agent"],
        **_listening(names.AGENT_PORT, names.AGENT_HEALTH_PORT, environment),
        "resources": resources(AGENT_REQUESTS, recipe.images.memory_limit),
        "securityContext": copy.deepcopy(HARDENED),
        "volumeMounts": [
            {"name": names.AGENT_VOLUME, "mountPath": names.AGENT_DIR},
            {"name": names.MEMORY_VOLUME, "mountPath": names.MEMORY_DIR},
            {"name": names.TOKEN_VOLUME, "mountPath": names.SECRET_DIR, "readOnly": True},
            *profiles,
            *(_seen_waiting(container) for container in held),
        ],
    }
