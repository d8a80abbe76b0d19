"""Labels, annotations, ports and names of the objects that belong to a workload or a pool.

One place, since the operator, the monitor, the agent, the admission policy of the chart and users' selectors
must all mean the same. Imports nothing, since the agent, of which there is one in every pod, needs it too.
"""

from __future__ import annotations

GROUP = "understudy.dev"

WORKLOAD = f"{GROUP}/workload"
"""On every instance: the RobotWorkload whose robot it may drive. Both gate policies select by it."""

INSTANCE = f"{GROUP}/instance"
"""On every instance: its own pod name, so that the gate can select exactly one."""

POOL = f"{GROUP}/pool"
"""On pods that a FallbackPool made."""

HELD = f"{GROUP}/held"
"""On unclaimed pods of an Uninitialized pool (value ``true``): their processes wait and they may send nothing."""

PART = f"{GROUP}/part"
"""On pods of an Uninitialized pool: the part of it that they belong to, so that who needs one needn't ask for all of them."""

COMPONENT = f"{GROUP}/component"
"""``monitor``, ``discovery`` or ``instance``."""

MONITORED = f"{GROUP}/monitored"
"""On monitor and discovery pods: the workload they serve. Not WORKLOAD, which would gate them."""

HEALTH_TREE = f"{GROUP}/health-tree"
"""On ConfigMaps (value ``true``): whoever owns it lets FailurePolicies read health trees from it. Without that, who may write
policies could read ConfigMaps through them."""

SOURCE = f"{GROUP}/source"
"""On pods of the ReplicaSet that a template becomes: ``workload``."""

TEMPLATE_HASH = f"{GROUP}/template-hash"
"""On instances: hash of the template they were made from."""

PROFILES_HASH = f"{GROUP}/profiles-hash"
"""Annotation of pods: hash of the DDS profiles that their processes read when they start."""

PROCEDURE_HASH = f"{GROUP}/procedure-hash"
"""Annotation of standbys: hash of the procedure that brings them to their pool's readiness."""

EPOCH = f"{GROUP}/epoch"
"""Annotation of the gate: grows by one with every commit."""

ACTIVE = f"{GROUP}/active"
"""Annotation of the gate: name of the pod in control, empty while closed."""

ACTIVE_UID = f"{GROUP}/active-uid"
"""Annotation of the gate: UID of the pod in control, empty while closed."""

ADMITTED = f"{GROUP}/admitted"
"""Annotation of the gate: the standby that is let through beside the pod in control, for the reflex; mostly empty."""

ADMITTED_UID = f"{GROUP}/admitted-uid"
"""Annotation of the gate: its UID."""

RECOVERY = f"{GROUP}/recovery"
"""Annotation of the gate: the recovery that committed it, as JSON, so that a new monitor can finish it."""

SWITCHOVER = f"{GROUP}/switchover"
"""Annotation of a RobotWorkload: a switchover that somebody asks for (api/kinds/switchover_spec.py)."""

WAITS_FOR = f"{GROUP}/waits-for"
"""On a gate while its workload waits for a pod of a shared pool: that pool. Other monitors find by it who waits besides theirs."""

RESUMED = f"{GROUP}/resumed"
"""Annotation of a RobotWorkload: when somebody said to go on. What was spent of the budget before doesn't count, no pause is waited for."""

RESUMED_FOR = f"{GROUP}/resumed-for"
"""Annotation of a RobotWorkload: who said so and why, where they told it. Written with RESUMED, for people."""

CLAIM = f"{GROUP}/claim"
"""Annotation of a pool's pod: ``<workload uid>/<recovery id>``, written once, by the claim."""

CLAIMED_AT = f"{GROUP}/claimed-at"
"""Annotation of a pool's pod: when it was claimed, in whole unix seconds."""

GATE_CLOSED = "closed"
"""Value of INSTANCE in the gate's selector when no pod may send. No pod is called that: ours are NAME-xxxxx."""

GATE_PORTS = range(7950, 8149)
"""UDP ports on the robot's side that gated readers listen on."""

PROBE_PORT = 8149
"""UDP port of the monitor inside the gated range, to see from packets when a gate is enforced."""

GATE_RANGE = (7950, 8149)
"""First and last gated UDP port."""

AGENT_PORT = 8950
"""TCP port of the agent's control channel."""

AGENT_HEALTH_PORT = 8951
"""TCP port of the agent's readiness probe."""

METRICS_PORT = 9108
"""TCP port of the monitor's and the operator's Prometheus metrics and health pages."""

TASKS_PORT = 9109
"""TCP port of the task proxy's health page."""

RECORDINGS_PORT = 9110
"""TCP port of the monitor's recordings, open to its own pod alone: who may forward ports to it may have them."""

DISCOVERY_PORT = 11811
"""UDP port of the managed ROS discovery server."""

MONITOR_ACCOUNT_ENDING = "-understudy-monitor"

AGENT_CONTAINER = "understudy-agent"
AGENT_VOLUME = "understudy"
AGENT_DIR = "/understudy"
SECRET_DIR = "/etc/understudy/agent"

INIT_CONTAINER = "understudy-init"
"""Writes the profiles of an instance where they differ from pod to pod."""

TASKS_CONTAINER = "tasks"
"""The task proxy, beside the monitor in its pod."""

TASKS_DIR = "/run/understudy"
TASKS_SOCKET = "tasks.sock"
"""Where the monitor and the task proxy of a workload speak to each other."""

INSTANCE_PROFILES_VOLUME = "understudy-profiles"
INSTANCE_PROFILES_DIR = "/etc/understudy-profiles"
"""Where the profiles for instances are mounted in their pods."""

PROFILES_KEY = "profiles.xml"
PROFILES_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
"""Names a process's profiles to Fast DDS on Jazzy."""

POD_VARIABLE = "UNDERSTUDY_POD"
"""The name of the pod, in the environment of an instance's containers; Fast DDS puts it into the profiles."""

GATE_KIND_VARIABLE = "UNDERSTUDY_GATE_KIND"
"""The kind of a workload's gate (``spec.gate.kind``), for its monitor."""

MONITOR_IMAGE_VARIABLE = "UNDERSTUDY_MONITOR_IMAGE"
"""What monitors are made of, for the operator; what it's made of, for a monitor."""

FENCED_VARIABLE = "UNDERSTUDY_FENCED_CONTAINERS"
UNFENCED_VARIABLE = "UNDERSTUDY_UNFENCED_CONTAINERS"
"""The containers whose application the agent can hold while their pod is cut off, and those where it can't."""

STRENGTH_VARIABLE = "UNDERSTUDY_STRENGTH"
"""Stands in the profiles for an instance's ownership strength, which is put in before any process reads them."""


def gate(workload: str) -> str:
    """The gate object of a workload: its commit point."""
    return f"{workload}-gate"


def standby(workload: str) -> str:
    """The object under which every instance is kept from the robot, unless the gate lets it through."""
    return f"{workload}-standby"


def standby_reference(workload: str) -> str:
    """The same for the pods of a referred controller, which it selects by that controller's own selector."""
    return f"{workload}-standby-ref"


def monitor(workload: str) -> str:
    """The monitor's Deployment, Role and RoleBinding."""
    return f"{workload}-monitor"


def monitor_account(workload: str) -> str:
    """The monitor's ServiceAccount; the chart's admission policy recognizes monitors by its ending."""
    return f"{workload}{MONITOR_ACCOUNT_ENDING}"


def discovery(workload: str) -> str:
    """The managed discovery server's Deployment and Service."""
    return f"{workload}-discovery"


def in_control(workload: str) -> str:
    """The PodDisruptionBudget that has an eviction of the instance in control wait."""
    return f"{workload}-in-control"


def robot_env(workload: str) -> str:
    """ConfigMap with the environment for the robot's side (``envFrom``)."""
    return f"{workload}-robot-env"


def robot_profiles(workload: str) -> str:
    """ConfigMap with ``profiles.xml`` for the robot's side (mounted at /etc/understudy)."""
    return f"{workload}-robot-profiles"


def instance_profiles(workload: str) -> str:
    """ConfigMap with ``profiles.xml`` for the instances, where tasks or the reflex need it."""
    return f"{workload}-instance-profiles"


def settings(workload: str) -> str:
    """ConfigMap with ``settings.json``: what the monitor needs to know that is not in the spec."""
    return f"{workload}-settings"


def agent_secret(workload: str) -> str:
    """Secret with ``token`` for the agents of a workload's own instances."""
    return f"{workload}-agent"


def held(pool: str) -> str:
    """The object that isolates a pool's unclaimed pods."""
    return f"{pool}-held"


def pool_secret(pool: str) -> str:
    """Secret with ``token`` for the agents of a pool's held pods, and of those that were claimed from it."""
    return f"{pool}-pool-agent"
