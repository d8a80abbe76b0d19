"""The monitor of a workload: its Deployment, and an account that may do no more than protect this one workload."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.base import GROUP
from understudy.api.kinds.robot_workload import MonitorSettings
from understudy.controller.desired.discovery_server import TOLERATIONS
from understudy.controller.plan import Images, priority, pull_secrets
from understudy.controller.pods import ros_environment
from understudy.controller.pods.instance_pod import HARDENED
from understudy.controller.pods.pod_placement import away_from
from understudy.kube.apply import digest
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind
from understudy.ros.rmw import MIDDLEWARE

STATE_DIR = "/var/lib/understudy"
# Of a busy node's processors it gets its share by this, and in a recovery it needs more at once than what it uses (15m).
_REQUESTS = {"cpu": "50m", "memory": "96Mi"}
_TASKS_REQUESTS = {"cpu": "20m", "memory": "96Mi"}
_DISTANCE = 100  # the loss of one node must not take both the pod in control and the one that replaces it
_TASKS_MOUNT: Object = {"name": "tasks", "mountPath": names.TASKS_DIR}
_RBAC = "rbac.authorization.k8s.io"

KEPT_VOLUME = "kept"
"""Volume of a PersistentVolumeClaim for kept state."""


def claimed(deployment: Object | None) -> str | None:
    """The claim that a monitor has its kept state on; None where that is in an emptyDir."""
    volumes = deployment["spec"]["template"]["spec"].get("volumes") or [] if deployment else []
    found = (v["persistentVolumeClaim"]["claimName"] for v in volumes if v["name"] == KEPT_VOLUME)
    return next(found, None)


def labels(workload: str) -> dict[str, str]:
    """Labels of the monitor's pods."""
    return {names.COMPONENT: "monitor", names.MONITORED: workload}


def deployment(
    workload: str,
    namespace: str,
    settings: MonitorSettings,
    images: Images,
    environment: Mapping[str, str],
    profiles: str,
    *,
    gate: str,
    tasks: bool = False,
    claim: str | None = None,
) -> Object:
    """The monitor. Its readers have the gated ports, so that it sees what the robot sees.

    ``profiles`` is the text of the profile file: when that changes, a process that has read it must start again.
    ``gate`` is the kind of the workload's gate, ``tasks`` whether there is a task proxy beside it, ``claim`` the PersistentVolumeClaim
    for kept state.
    """
    fixed = {
        "UNDERSTUDY_WORKLOAD": workload,
        "UNDERSTUDY_NAMESPACE": namespace,
        names.GATE_KIND_VARIABLE: gate,
        names.MONITOR_IMAGE_VARIABLE: settings.image or images.monitor,
        "HOME": STATE_DIR,
        "ROS_LOG_DIR": f"{STATE_DIR}/log",
        MIDDLEWARE.settings_variable: ros_environment.PROFILES_FILE,
        **MIDDLEWARE.introspecting(environment),
    }
    container: Object = {
        "name": "monitor",
        "image": settings.image or images.monitor,
        "imagePullPolicy": images.pull_policy,
        "args": ["monitor"],
        "env": [
            *({"name": key, "value": value} for key, value in sorted(fixed.items())),
            {
                "name": "UNDERSTUDY_POD_IP",
                "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "status.podIP"}},
            },
            {
                "name": "UNDERSTUDY_POD",
                "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": "metadata.name"}},
            },
        ],
        "ports": [{"name": "metrics", "containerPort": names.METRICS_PORT, "protocol": "TCP"}],
        "readinessProbe": {
            "httpGet": {"path": "/ready", "port": names.METRICS_PORT},
            "periodSeconds": 2,
            "timeoutSeconds": 2,
        },
        "resources": settings.resources or {"requests": dict(_REQUESTS)},
        "securityContext": HARDENED,
        "volumeMounts": [
            {"name": "state", "mountPath": STATE_DIR},
            {"name": "profiles", "mountPath": ros_environment.PROFILES_DIR, "readOnly": True},
        ],
    }
    containers, shared = [container], []
    if tasks:
        container["volumeMounts"].append(dict(_TASKS_MOUNT))
        containers.append(_tasks(workload, namespace, settings, images, environment))
        shared.append({"name": _TASKS_MOUNT["name"], "emptyDir": {}})
    owned: Object = {}
    if claim:
        # A policy serves many workloads, and its claim all of their monitors: each has a folder of its own.
        container["volumeMounts"].append({"name": KEPT_VOLUME, "mountPath": f"{STATE_DIR}/kept", "subPath": workload})
        shared.append({"name": KEPT_VOLUME, "persistentVolumeClaim": {"claimName": claim}})
        group = HARDENED["runAsGroup"]
        owned = {"securityContext": {"fsGroup": group, "fsGroupChangePolicy": "OnRootMismatch"}}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": names.monitor(workload), "labels": labels(workload)},
        "spec": {
            "replicas": 1,
            "strategy": {"type": "Recreate"},
            "selector": {"matchLabels": labels(workload)},
            "template": {
                "metadata": {
                    "labels": labels(workload),
                    "annotations": {names.PROFILES_HASH: digest(profiles)},
                },
                "spec": {
                    "serviceAccountName": names.monitor_account(workload),
                    "automountServiceAccountToken": True,
                    "enableServiceLinks": False,
                    "terminationGracePeriodSeconds": 5,
                    "tolerations": TOLERATIONS,
                    "affinity": {
                        "podAntiAffinity": {
                            "preferredDuringSchedulingIgnoredDuringExecution": [
                                away_from({names.WORKLOAD: workload}, _DISTANCE)
                            ]
                        }
                    },
                    **owned,
                    **priority(images),
                    **pull_secrets(images.pull_secrets),
                    "containers": containers,
                    "volumes": [
                        {"name": "state", "emptyDir": {}},
                        {"name": "profiles", "configMap": {"name": names.robot_profiles(workload)}},
                        *shared,
                    ],
                },
            },
        },
    }


def _tasks(
    workload: str, namespace: str, settings: MonitorSettings, images: Images, environment: Mapping[str, str]
) -> Object:
    """The task proxy: a process of its own, since it must answer clients while the monitor is busy with a failure.

    It has no profiles: two processes of a pod can't have the same gated ports, and its servers are in no partition.
    """
    fixed = {
        "UNDERSTUDY_WORKLOAD": workload,
        "UNDERSTUDY_NAMESPACE": namespace,
        "HOME": STATE_DIR,
        "ROS_LOG_DIR": f"{STATE_DIR}/log",
        **environment,
    }
    return {
        "name": names.TASKS_CONTAINER,
        "image": settings.image or images.monitor,
        "imagePullPolicy": images.pull_policy,
        "args": ["tasks"],
        "env": [{"name": key, "value": value} for key, value in sorted(fixed.items())],
        "ports": [{"name": "tasks", "containerPort": names.TASKS_PORT, "protocol": "TCP"}],
        # Its restart loses no goal and still costs seconds: on a busy node it is given a minute.
        "livenessProbe": {
            "httpGet": {"path": "/healthz", "port": names.TASKS_PORT},
            "initialDelaySeconds": 10,
            "periodSeconds": 10,
            "timeoutSeconds": 5,
            "failureThreshold": 6,
        },
        "resources": {"requests": dict(_TASKS_REQUESTS)},
        "securityContext": HARDENED,
        "volumeMounts": [{"name": "state", "mountPath": STATE_DIR}, dict(_TASKS_MOUNT)],
    }


def asks_by_name(workload: Object, *deployments: Object | None) -> bool:
    """Whether the monitor asks for its policy alone, and for who waits only where there is a pool: in all these Deployments.

    One before 0.2.0 asks for all of the namespace. An image of a user's own may be of such a version for long after an upgrade of the
    operator, and without that right it would watch nothing once it starts anew. So it's the monitor that says of which version its
    image is.
    """
    said = ((workload.get("status") or {}).get("monitor") or {}).get("image")
    images = {item["spec"]["template"]["spec"]["containers"][0].get("image") for item in deployments if item}
    return bool(said) and images == {said}


def access(
    workload: str,
    *,
    source: tuple[str, str],
    policy: str | None,
    pools: Sequence[str],
    upstream: Sequence[str] = (),
    gate: GateKind = registry.DEFAULT,
) -> list[tuple[str, Object]]:
    """The monitor's account, role and binding, each with its kind.

    ``source`` is kind and name of the controller that replaces pods; ``policy`` the FailurePolicy that it reads, None for one that
    doesn't ask by name (asks_by_name); ``pools`` are the shared pools whose agents it may command; ``upstream`` the workloads that it
    depends on, of which it may read how they are; ``gate`` is the kind of its gate.
    """
    source_kind, source_name = source
    tokens = [names.agent_secret(workload), *(names.pool_secret(pool) for pool in sorted(pools))]
    watch = ["get", "list", "watch"]
    rules = [
        _rule("", ["pods"], [*watch, "patch", "delete"]),
        _rule("metrics.k8s.io", ["pods"], ["list"]),
        *gate.monitor_rules(workload),
        _rule(GROUP, ["robotworkloads"], watch, [workload, *sorted(upstream)]),
        _rule(GROUP, ["robotworkloads/status"], ["patch"], [workload]),
        _rule(GROUP, ["failurepolicies"], watch, [policy] if policy is not None else None),
        _rule("", ["configmaps"], watch, [names.settings(workload)]),
        _rule("", ["secrets"], ["get"], tokens),
        _rule("apps", [f"{source_kind.lower()}s"], watch, [source_name]),
        _rule("", ["events"], ["list", "create", "patch"]),
    ]
    if pools or policy is None:
        # The gates of others tell who else waits for a pod of a shared pool.
        rules += [_rule(one.group, [one.plural], ["list", "watch"]) for one in registry.GATE_RESOURCES]
    if source_kind == "ReplicaSet":
        rules.append(_rule("apps", ["replicasets/scale"], ["get", "patch"], [source_name]))
    metadata = {"name": names.monitor(workload), "labels": labels(workload)}
    account = names.monitor_account(workload)
    return [
        (
            "ServiceAccount",
            {
                "apiVersion": "v1",
                "kind": "ServiceAccount",
                "metadata": {"name": account, "labels": labels(workload)},
            },
        ),
        ("Role", {"apiVersion": f"{_RBAC}/v1", "kind": "Role", "metadata": metadata, "rules": rules}),
        (
            "RoleBinding",
            {
                "apiVersion": f"{_RBAC}/v1",
                "kind": "RoleBinding",
                "metadata": metadata,
                "roleRef": {"apiGroup": _RBAC, "kind": "Role", "name": names.monitor(workload)},
                "subjects": [{"kind": "ServiceAccount", "name": account}],
            },
        ),
    ]


def commanded(role: Object | None) -> frozenset[str]:
    """The shared pools whose agents a monitor may command by its role."""
    rules = (role or {}).get("rules") or []
    found = (name for rule in rules if "secrets" in rule["resources"] for name in rule.get("resourceNames") or [])
    ending = names.pool_secret("")
    return frozenset(name.removesuffix(ending) for name in found if name.endswith(ending))


def _rule(
    group: str, resources: Sequence[str], verbs: Sequence[str], only: Sequence[str] | None = None
) -> dict[str, Any]:
    rule: dict[str, Any] = {"apiGroups": [group], "resources": list(resources), "verbs": list(verbs)}
    return rule | ({"resourceNames": list(only)} if only else {})
