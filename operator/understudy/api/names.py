"""Labels, annotations, ports and names of the objects that belong to a workload or a pool.

The operator, the monitor, the agent, the chart's admission policy and users' selectors must agree on them, so they are defined
once. Imports nothing, because every pod's agent imports this module.
"""

from __future__ import annotations

import re

GROUP = "understudy.dev"

WORKLOAD = f"{GROUP}/workload"
"""On every instance: the RobotWorkload whose robot it may control. All policies of the gate select by this label. On pods of a shared pool
it has the value UNCLAIMED, also after their claim: for some networks, other labels are another identity (see CLAIMED_BY)."""

UNCLAIMED = ""
"""Value of WORKLOAD on pods of a shared pool, and of CLAIMED_BY on those that are unclaimed. No workload has this name."""

CLAIMED_BY = f"annotation.{GROUP}/claimed-by"
"""On pods of a shared pool: the RobotWorkload that has claimed the pod, or UNCLAIMED. It is the only label that a claim changes.

Cilium makes identities of labels. If a label of a pod changes, it applies no change of a policy to that pod for up to 35 s. By default it
ignores labels that begin with ``annotation`` (and some of Kubernetes). No policy selects by this label.
"""

INSTANCE = f"{GROUP}/instance"
"""On every instance: its own pod name, so that the gate can select exactly one instance."""

POOL = f"{GROUP}/pool"
"""On pods that belong to a FallbackPool."""

HELD = f"{GROUP}/held"
"""On pods of an Uninitialized pool (value ``true``): their processes wait, and they may not send, until CLAIMED_BY names a workload."""

PART = f"{GROUP}/part"
"""On pods of an Uninitialized pool: the part of the pool that they belong to, so that a monitor can list only some of them."""

COMPONENT = f"{GROUP}/component"
"""``monitor``, ``discovery`` or ``instance``."""

MONITORED = f"{GROUP}/monitored"
"""On monitor and discovery pods: the workload they serve. They do not have WORKLOAD, which would put them behind the gate."""

HEALTH_TREE = f"{GROUP}/health-tree"
"""On ConfigMaps (value ``true``): allows FailurePolicies to read health trees from the ConfigMap. Without this label, users who may
write policies could read any ConfigMap."""

SOURCE = f"{GROUP}/source"
"""On pods of the ReplicaSet that is made from a template: ``workload``."""

TEMPLATE_HASH = f"{GROUP}/template-hash"
"""On instances: hash of the template from which they were made."""

PROFILES_HASH = f"{GROUP}/profiles-hash"
"""Annotation of pods: hash of the DDS profiles that their processes read when they start."""

PROCEDURE_HASH = f"{GROUP}/procedure-hash"
"""Annotation of standbys: hash of the procedure that brings them to the readiness of their pool."""

EPOCH = f"{GROUP}/epoch"
"""Annotation of the gate: increases by one with every commit."""

ACTIVE = f"{GROUP}/active"
"""Annotation of the gate: name of the active pod, empty while the gate is closed."""

ACTIVE_UID = f"{GROUP}/active-uid"
"""Annotation of the gate: UID of the active pod, empty while the gate is closed."""

ADMITTED = f"{GROUP}/admitted"
"""Annotation of the gate: name of a standby that may send in addition to the active pod, for the reflex. Usually empty."""

ADMITTED_UID = f"{GROUP}/admitted-uid"
"""Annotation of the gate: UID of that standby."""

LET_THROUGH = f"{GROUP}/let-through"
"""Annotation of the gate: name, UID and IP of the pods that it let through of late, as JSON, newest first."""

FENCED = f"{GROUP}/fenced"
"""Annotation of the gate: the generation of the RobotWorkload since which a user has fenced the robot. The gate stays closed until the
pause that belongs to it has ended. A monitor that has not seen this generation does not know whether it has."""

RECOVERY = f"{GROUP}/recovery"
"""Annotation of the gate: the recovery that committed it, as JSON, so that a new monitor can complete it."""

SERVER = f"{GROUP}/server"
"""Annotation of a discovery server's Service: the UID of the server's pod and its age (understudy.controller.desired.discovery_server)."""
BESIDE = f"{GROUP}/beside"
"""Annotation of a discovery server's pod: UID and address (UID/ADDRESS) of its predecessor's pod, whose process may live on."""

OVERTAKEN = f"{GROUP}/overtaken"
"""Annotation of the gate: the last recovery that was abandoned without an answer to its commit. The API server now refuses this commit."""

SWITCHOVER = f"{GROUP}/switchover"
"""Annotation of a RobotWorkload: a requested switchover (api/kinds/switchover_spec.py)."""

WAITS_FOR = f"{GROUP}/waits-for"
"""Label of the gate while its workload waits for a pod of a shared pool: the pool. Other monitors read it to see who waits."""

RESUMED = f"{GROUP}/resumed"
"""Annotation of a RobotWorkload: when a user resumed it. Earlier recoveries do not count against the budget, and no backoff applies."""

RESUMED_FOR = f"{GROUP}/resumed-for"
"""Annotation of a RobotWorkload: who resumed it and why, if they said so. For people, written together with RESUMED."""

CLAIM = f"{GROUP}/claim"
"""Annotation of a pool's pod: ``<workload uid>/<recovery id>``, written once when the pod is claimed."""

CLAIMED_AT = f"{GROUP}/claimed-at"
"""Annotation of a pool's pod: when it was claimed, in whole unix seconds."""

REPLACES = f"{GROUP}/replaces"
"""Annotation of a standby that was created to replace another pod on another node: the UID of that pod."""

NOT_MOVED = f"{GROUP}/not-moved"
"""Annotation of a standby on the node of the active instance: when its replacement elsewhere could not start, in whole unix seconds."""

NOBODY = "closed"
"""Value of INSTANCE in the selector of a policy that selects no instance, such as a closed gate. No pod has this name, because instances
are called NAME-xxxxx."""

GATE_PORTS = range(7950, 8149)
"""UDP ports on which gated readers listen at the robot."""

PROBE_PORT = 8149
"""UDP port of the monitor inside the gated range. The monitor sees from its packets whether a gate is enforced."""

GATE_RANGE = (7950, 8149)
"""First and last gated UDP port."""

AGENT_PORT = 8950
"""TCP port of the agent's control channel."""

AGENT_HEALTH_PORT = 8951
"""TCP port of the agent's readiness probe."""

NODE_AGENT_PORTS = range(20000, 30000)
"""TCP ports of agents in the network of their node: two of them for each, below those of Services and outgoing connections."""

AGENT_PORT_NAME = "us-agent"
"""Name of AGENT_PORT in the agent's container. A monitor finds the port of an agent by it."""

AGENT_PORT_VARIABLE = "UNDERSTUDY_AGENT_PORT"
AGENT_HEALTH_PORT_VARIABLE = "UNDERSTUDY_AGENT_HEALTH_PORT"
"""Environment of an agent that listens on other ports."""

METRICS_PORT = 9108
"""TCP port of the monitor's and the operator's Prometheus metrics and health pages."""

TASKS_PORT = 9109
"""TCP port of the action proxy's health page."""

RECORDINGS_PORT = 9110
"""TCP port of the monitor's recordings. Only the monitor's own pod can reach it, so downloads need the right to forward ports."""

DISCOVERY_PORT = 11811
"""UDP port of the managed ROS discovery server."""

DISCOVERY_ASKED_PORT = 11812
"""UDP port at which managed discovery servers ask each other who is behind their Service."""

DISCOVERY_ASKED_VARIABLE = "UNDERSTUDY_DISCOVERY_ASKED"

DISCOVERY_BESIDE_VARIABLE = "UNDERSTUDY_DISCOVERY_BESIDE"
"""The file with the annotation BESIDE of a discovery server's own pod."""

MONITOR_ACCOUNT_ENDING = "-understudy-monitor"

AGENT_CONTAINER = "understudy-agent"
TOKEN_VOLUME = "understudy-agent-token"
"""Volume of instances with the token that their agent accepts."""

AGENT_VOLUME = "understudy"
"""Volume that an instance's agent and application share. Only the agent and the init container write to it."""

AGENT_DIR = "/understudy"

MEMORY_VOLUME = "understudy-agent-memory"
"""Volume that only the agent has."""

MEMORY_DIR = "/var/lib/understudy-agent"
MEMORY_VARIABLE = "UNDERSTUDY_MEMORY_DIR"
"""Environment variable of the agent with its path."""
SECRET_DIR = "/etc/understudy/agent"
TOKEN = "token"
"""Entry of the agents' Secret, and file of an agent, with the token that it accepts."""

MONITOR_PUBLIC_KEY = "monitor-public-key"
"""Entry and file with the key that shows an agent who its monitor is."""

MONITOR_PRIVATE_KEY = "monitor-private-key"
"""Entry with the key of the monitor. No pod mounts it."""

MONITOR_KEYS = f"{GROUP}/monitor-keys"
"""Annotation of a Secret that has both keys. The operator keeps no copy of the entries."""

INIT_CONTAINER = "understudy-init"
"""Init container that writes an instance's DDS profiles if they differ between pods."""

TASKS_CONTAINER = "tasks"
"""The action proxy, a container in the monitor's pod."""

TASKS_DIR = "/run/understudy"
TASKS_SOCKET = "tasks.sock"
"""Socket through which the monitor and the action proxy of a workload communicate."""

INSTANCE_PROFILES_VOLUME = "understudy-profiles"
INSTANCE_PROFILES_DIR = "/etc/understudy-profiles"
"""Mount path of the DDS profiles in instances."""

PROFILES_KEY = "profiles.xml"

POD_VARIABLE = "UNDERSTUDY_POD"
"""Environment variable of an instance's and of a monitor's containers with the name of the pod, which Fast DDS puts into the profiles."""

POD_UID_VARIABLE = "UNDERSTUDY_POD_UID"
"""Environment variable with the UID of the pod."""

AGENT_PROTOCOL_VARIABLE = "UNDERSTUDY_AGENT_PROTOCOL"
"""Environment variable of an agent's container with the version of the protocol that the agent knows at least. Monitors read it from the
pod's spec and accept no older version. Pods of Understudy before version 0.3 do not have it."""

GATE_KIND_VARIABLE = "UNDERSTUDY_GATE_KIND"
"""The kind of a workload's gate (``spec.gate.kind``), for its monitor."""

MONITOR_IMAGE_VARIABLE = "UNDERSTUDY_MONITOR_IMAGE"
"""Environment variable with an image: for the operator, the image of new monitors; for a monitor, its own image."""

WORKLOAD_VARIABLE = "UNDERSTUDY_WORKLOAD"
"""Environment variable of Understudy's own processes with the workload that they serve; empty in unclaimed pods of shared pools."""

STATE_DIR = "/var/lib/understudy"
"""Where monitors and muxes keep their state."""

MUX_TOKEN_FILE = "/etc/understudy-mux/token"
"""Where a mux of one workload reads its token by default: the Secret :func:`mux` is mounted there."""

MUX_TOKEN_VARIABLE = "UNDERSTUDY_TOKEN_FILE"
"""Environment variable of a mux with another file that has its token."""

MUX_FOLDER = "/etc/understudy-mux"
"""Where a mux of several workloads finds by default a folder for each, with what the ConfigMap and the Secret :func:`mux` contain."""

MUX_FOLDER_VARIABLE = "UNDERSTUDY_MUX_FOLDER"
"""Environment variable of a mux with another folder than MUX_FOLDER."""

MUX_STATE_VARIABLE = "UNDERSTUDY_STATE"
"""Environment variable of a mux with another folder than STATE_DIR."""

ADDRESS_VARIABLE = "UNDERSTUDY_ADDRESS"
"""Environment variable of a mux with the address of its host, if that has several."""

NAMESPACE_VARIABLE = "UNDERSTUDY_NAMESPACE"
"""Environment variable of Understudy's own processes with the namespace of the workload."""

OUTPUTS_VARIABLE = "UNDERSTUDY_OUTPUTS"
"""Environment variable of a mux with the outputs of its workload, as in the spec, in JSON."""

ALLOWED_NODES_VARIABLE = "UNDERSTUDY_ALLOWED_NODES"
"""Environment variable of a mux with the nodes that may write outputs beside it, in JSON."""

FENCED_VARIABLE = "UNDERSTUDY_FENCED_CONTAINERS"
UNFENCED_VARIABLE = "UNDERSTUDY_UNFENCED_CONTAINERS"
"""Environment variables with the containers that the agent can hold while the pod is cut off, and those that it cannot hold."""

APART_PROFILE = "understudy_apart"
"""Name of the profile of all writers that have no other one, if they are in the partition of the pod. An agent looks for it."""

STRENGTH_VARIABLE = "UNDERSTUDY_STRENGTH"
"""Placeholder in the profiles for an instance's ownership strength. It is replaced before any process reads them."""


def gate(workload: str) -> str:
    """Name of the gate object of a workload, which is its commit point."""
    return f"{workload}-gate"


def standby(workload: str) -> str:
    """Name of the object that blocks every instance from the robot unless the gate admits it."""
    return f"{workload}-standby"


def claimed(workload: str) -> str:
    """Name of the policy of pods that a workload has just claimed, for networks that follow changes of labels late."""
    return f"{workload}-claimed"


def standby_reference(workload: str) -> str:
    """Name of the same policy for the pods of a referenced controller, which it selects with that controller's selector."""
    return f"{workload}-standby-ref"


def monitor(workload: str) -> str:
    """Name of the monitor's Deployment, Role and RoleBinding."""
    return f"{workload}-monitor"


def monitor_account(workload: str) -> str:
    """Name of the monitor's ServiceAccount. The chart's admission policy recognizes monitors by its suffix."""
    return f"{workload}{MONITOR_ACCOUNT_ENDING}"


def control_plane(workload: str) -> str:
    """Name of the network policy of the monitor and the managed discovery server."""
    return f"{workload}-control-plane"


def discovery(workload: str) -> str:
    """Name of the managed discovery server's Deployment and Service."""
    return f"{workload}-discovery"


def in_control(workload: str) -> str:
    """Name of the PodDisruptionBudget that makes an eviction of the active instance wait."""
    return f"{workload}-in-control"


def robot_env(workload: str) -> str:
    """Name of the ConfigMap with the environment for the robot's side (``envFrom``)."""
    return f"{workload}-robot-env"


def robot_profiles(workload: str) -> str:
    """Name of the ConfigMap with ``profiles.xml`` for the robot's side (mounted at /etc/understudy)."""
    return f"{workload}-robot-profiles"


def instance_profiles(workload: str) -> str:
    """Name of the ConfigMap with ``profiles.xml`` for the instances, if tasks or the reflex need it."""
    return f"{workload}-instance-profiles"


def settings(workload: str) -> str:
    """Name of the ConfigMap with ``settings.json``, which contains what the monitor needs beyond the spec."""
    return f"{workload}-settings"


def agent_secret(workload: str) -> str:
    """Name of the Secret with ``token`` for the agents of a workload's own instances."""
    return f"{workload}-agent"


def mux(workload: str) -> str:
    """Name of the ConfigMap with the environment of a workload's mux (``envFrom``), and of the Secret with its ``token``."""
    return f"{workload}-mux"


def on_board(workload: str) -> str:
    """Name of the ConfigMap with the environment of a workload's instance on board (``envFrom``), besides that of the robot."""
    return f"{workload}-on-board"


def held(pool: str) -> str:
    """Name of the object that isolates a pool's unclaimed pods."""
    return f"{pool}-held"


_POOL_SECRET = "-pool-agent"


def pool_secret(pool: str) -> str:
    """Name of the Secret with ``token`` for the agents of a pool's held pods and of pods that were claimed from it."""
    return f"{pool}{_POOL_SECRET}"


def pool_of_secret(secret: str) -> str:
    """Name of the pool that such a Secret is for; empty if the name is that of another Secret."""
    return secret.removesuffix(_POOL_SECRET) if secret.endswith(_POOL_SECRET) else ""


def in_ros(name: str) -> str:
    """Return a Kubernetes name as a part of a ROS name. What ROS does not allow becomes an underscore."""
    return re.sub(r"[^a-zA-Z0-9_]", "_", name)
