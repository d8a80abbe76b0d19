"""The monitor of a workload: its Deployment, and a ServiceAccount that can do no more than protect this workload."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.base import GROUP
from understudy.api.kinds.robot_workload import MonitorSettings
from understudy.controller import plan
from understudy.controller.desired.discovery_server import TOLERATIONS
from understudy.controller.plan import Images, from_field, priority, pull_secrets, variables
from understudy.controller.pods import ros_environment
from understudy.controller.pods.instance_pod import HARDENED
from understudy.controller.pods.pod_placement import away_from
from understudy.kube.apply import digest
from understudy.kube.client import NETWORK_POLICIES, Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind
from understudy.ros.rmw import MIDDLEWARE

STATE_DIR = names.STATE_DIR
# The request determines the monitor's share of a busy node's processors. In a recovery, the monitor briefly needs more
# than its average use (15m).
_REQUESTS = {"cpu": "50m", "memory": "96Mi"}
_TASKS_REQUESTS = {"cpu": "20m", "memory": "96Mi"}
_DISTANCE = 100  # the loss of one node must not take both the active instance and its monitor, which replaces it
_TASKS_MOUNT: Object = {"name": "tasks", "mountPath": names.TASKS_DIR}
_RBAC = "rbac.authorization.k8s.io"

KEPT_VOLUME = "kept"
"""Volume with a PersistentVolumeClaim for kept state."""


def claimed(deployment: Object | None) -> str | None:
    """Return the claim on which a monitor has its kept state, or None if the state is in an emptyDir."""
    volumes = deployment["spec"]["template"]["spec"].get("volumes") or [] if deployment else []
    found = (v["persistentVolumeClaim"]["claimName"] for v in volumes if v["name"] == KEPT_VOLUME)
    return next(found, None)


def labels(workload: str) -> dict[str, str]:
    """Return the labels of the monitor's pods."""
    return {names.COMPONENT: "monitor", names.MONITORED: workload}


def deployment(
    workload: str,
    namespace: str,
    settings: MonitorSettings,
    images: Images,
    environment: Mapping[str, str],
    profiles: tuple[str, str],
    *,
    gate: str,
    tasks: bool = False,
    claim: str | None = None,
    memory_limit: str = "",
    apart_from: str = "",
) -> Object:
    """Return the monitor's Deployment.

    ``profiles`` are the key and the text of the profile file: if it changes, a process that has read it must restart. Its readers have
    the gated ports, so that it sees what the robot sees, or are in the partitions that a mux reads.
    ``gate`` is the kind of the workload's gate; ``tasks`` says whether the pod has an action proxy; ``claim`` is the
    PersistentVolumeClaim for kept state. ``memory_limit`` applies if the settings contain no resources; empty for none.
    ``apart_from`` is an instance whose node the monitor avoids more than those of others.
    """
    fixed = {
        "UNDERSTUDY_WORKLOAD": workload,
        "UNDERSTUDY_NAMESPACE": namespace,
        names.GATE_KIND_VARIABLE: gate,
        names.MONITOR_IMAGE_VARIABLE: settings.image or images.monitor,
        "HOME": STATE_DIR,
        "ROS_LOG_DIR": f"{STATE_DIR}/log",
        MIDDLEWARE.settings_variable: f"{ros_environment.PROFILES_DIR}/{profiles[0]}",
        **MIDDLEWARE.introspecting(environment),
    }
    container: Object = {
        "name": "monitor",
        "image": settings.image or images.monitor,
        "imagePullPolicy": images.pull_policy,
        "args": ["monitor"],
        "env": [
            *variables(fixed),
            from_field("UNDERSTUDY_POD_IP", "status.podIP"),
            from_field(names.POD_VARIABLE, "metadata.name"),
            from_field(names.POD_UID_VARIABLE, "metadata.uid"),
        ],
        "ports": [{"name": "metrics", "containerPort": names.METRICS_PORT, "protocol": "TCP"}],
        "readinessProbe": {
            "httpGet": {"path": "/ready", "port": names.METRICS_PORT},
            "periodSeconds": 2,
            "timeoutSeconds": 2,
        },
        "livenessProbe": _alive(names.METRICS_PORT, after=60),
        "resources": settings.resources or plan.resources(_REQUESTS, memory_limit),
        "securityContext": HARDENED,
        "volumeMounts": [
            {"name": "state", "mountPath": STATE_DIR},
            {"name": "profiles", "mountPath": ros_environment.PROFILES_DIR, "readOnly": True},
        ],
    }
    containers, shared = [container], []
    apart = [away_from({names.WORKLOAD: workload}, _DISTANCE)]
    if apart_from:
        apart.append(away_from({names.INSTANCE: apart_from}, _DISTANCE))
    if tasks:
        container["volumeMounts"].append(dict(_TASKS_MOUNT))
        containers.append(_tasks(workload, namespace, settings, images, environment))
        shared.append({"name": _TASKS_MOUNT["name"], "emptyDir": {}})
    owned: Object = {}
    if claim:
        # A policy serves many workloads, and its claim serves all their monitors, so each has its own folder.
        for one in containers:
            one["volumeMounts"].append({"name": KEPT_VOLUME, "mountPath": f"{STATE_DIR}/kept", "subPath": workload})
        shared.append({"name": KEPT_VOLUME, "persistentVolumeClaim": {"claimName": claim}})
        group = HARDENED["runAsGroup"]
        owned = {"securityContext": {"fsGroup": group, "fsGroupChangePolicy": "OnRootMismatch"}}
    pod: Object = {
        "serviceAccountName": names.monitor_account(workload),
        "automountServiceAccountToken": True,
        "terminationGracePeriodSeconds": 5,
        "tolerations": TOLERATIONS,
        "affinity": {
            "podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": apart},
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
    }
    hashes = {names.PROFILES_HASH: digest(profiles[1])}
    return plan.deployment(names.monitor(workload), labels(workload), hashes, pod)


def _tasks(
    workload: str, namespace: str, settings: MonitorSettings, images: Images, environment: Mapping[str, str]
) -> Object:
    """Return the container of the action proxy.

    It is a separate process, because it must answer clients while the monitor is busy with a failure. It has no
    profiles: two processes of a pod cannot have the same gated ports, and its servers are in no partition.
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
        "env": variables(fixed),
        "ports": [{"name": "tasks", "containerPort": names.TASKS_PORT, "protocol": "TCP"}],
        "livenessProbe": _alive(names.TASKS_PORT, after=10),
        "resources": plan.resources(_TASKS_REQUESTS, images.memory_limit),
        "securityContext": HARDENED,
        "volumeMounts": [{"name": "state", "mountPath": STATE_DIR}, dict(_TASKS_MOUNT)],
    }


def _alive(port: int, *, after: int) -> Object:
    """Return the liveness probe of a process that starts within ``after`` seconds also on a busy node.

    A restart takes seconds, in which nobody watches the robot or serves its goals, so the process has a minute to answer.
    """
    return {
        "httpGet": {"path": "/healthz", "port": port},
        "initialDelaySeconds": after,
        "periodSeconds": 10,
        "timeoutSeconds": 5,
        "failureThreshold": 6,
    }


def asks_by_name(workload: Object, *deployments: Object | None) -> bool:
    """Whether the image of all these Deployments reads only its own policy, and other gates only if there is a pool.

    A monitor before 0.2.0 reads all policies of the namespace. A user's own image may contain such a version long after
    an upgrade of the operator, and without that right it would watch nothing after its next start. So this function
    relies on the image that the monitor reports in the workload's status.
    """
    reported = ((workload.get("status") or {}).get("monitor") or {}).get("image")
    images = {item["spec"]["template"]["spec"]["containers"][0].get("image") for item in deployments if item}
    return bool(reported) and images == {reported}


def access(
    workload: str,
    *,
    source: tuple[str, str],
    policy: str | None,
    pools: Sequence[str],
    upstream: Sequence[str] = (),
    gate: GateKind = registry.DEFAULT,
) -> list[tuple[str, Object]]:
    """Return the monitor's ServiceAccount, Role and RoleBinding, each with its kind.

    ``source`` is kind and name of the controller that replaces pods. ``policy`` is the FailurePolicy that the monitor
    reads, or None for a monitor that does not read it by name (see asks_by_name).
    ``pools`` are the shared pools whose agents it may command. ``upstream`` are the workloads that it depends on and
    whose health and gates it may read. ``gate`` is the kind of its gate.
    """
    source_kind, source_name = source
    tokens = [
        names.agent_secret(workload),
        *(names.pool_secret(pool) for pool in sorted(pools)),
        *gate.secrets(workload),
    ]
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
    if upstream:
        gates = [names.gate(one) for one in sorted(upstream)]
        rules += [_rule(one.group, [one.plural], watch, gates) for one in registry.GATE_RESOURCES]
    if pools or policy is None:
        # The gates of other workloads show which of them wait for a pod of a shared pool.
        rules += [_rule(one.group, [one.plural], ["list", "watch"]) for one in registry.GATE_RESOURCES]
    if pools:
        rules.append(_rule(NETWORK_POLICIES.group, [NETWORK_POLICIES.plural], ["patch"], [names.claimed(workload)]))
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
    """Return the shared pools whose agents a monitor may command, according to its Role."""
    rules = (role or {}).get("rules") or []
    found = (name for rule in rules if "secrets" in rule["resources"] for name in rule.get("resourceNames") or [])
    ending = names.pool_secret("")
    return frozenset(name.removesuffix(ending) for name in found if name.endswith(ending))


def _rule(
    group: str, resources: Sequence[str], verbs: Sequence[str], only: Sequence[str] | None = None
) -> dict[str, Any]:
    rule: dict[str, Any] = {"apiGroups": [group], "resources": list(resources), "verbs": list(verbs)}
    return rule | ({"resourceNames": list(only)} if only else {})
