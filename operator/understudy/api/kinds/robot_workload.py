"""RobotWorkload: one application of one robot, its outputs to the robot, and the policy that protects it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from understudy.api.base import (
    Duration,
    LocalReference,
    Model,
    ObjectName,
    ReportedText,
    RosName,
    UnknownContent,
    length,
    matching,
    seconds,
    unique,
    with_rules,
)
from understudy.api.conditions import Conditions, Time
from understudy.api.kinds.failure_policy import MOST_COUNTED
from understudy.api.kinds.label_selector import LabelSelector
from understudy.api.kinds.pause_spec import Pause
from understudy.api.kinds.pod_template import pod_template
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.situation_spec import SituationStatus
from understudy.api.kinds.state_spec import KeptStatus, RestoredState
from understudy.api.kinds.switchover_spec import Draining, Kind, SwitchoverStatus
from understudy.api.kinds.task_spec import Task, TaskStatus
from understudy.api.ros_names import ROS_TYPE_MESSAGE, ROS_TYPE_PATTERN

STOCKED_MOST = 8
"""Maximum number of shared pools that a status lists as having a pod for a workload."""

Health = Literal["Unknown", "Starting", "Healthy", "Degraded", "Failed", "Recovering"]

TOPIC_LIFESPAN = "100ms"
"""Default of ``outputs[].lifespan`` for topics: about one period of the slower control loops."""

REQUEST_LIFESPAN = "1s"
"""Default of ``outputs[].lifespan`` for services and actions: their calls have no period, and must survive a lost packet."""

_BYTE = r"(25[0-5]|2[0-4][0-9]|1[0-9][0-9]|[1-9]?[0-9])"
CIDR_PATTERN = rf"^(({_BYTE}\.){{3}}{_BYTE}/([1-9]|[12][0-9]|3[0-2])|[0-9a-fA-F:]*:[0-9a-fA-F:]*/([1-9]|[1-9][0-9]|1[01][0-9]|12[0-8]))$"
CIDR_MESSAGE = "write addresses as a CIDR, such as 192.168.10.0/24 or 192.168.10.7/32; a /0 would include the pods"

Cidr = Annotated[str, matching(CIDR_PATTERN, CIDR_MESSAGE, max_length=43)]
"""A range of IP addresses outside the cluster."""


@with_rules(
    (
        "[has(self.topic), has(self.service), has(self.action)].filter(x, x).size() == 1",
        "give exactly one of topic, service and action",
    ),
    (
        "!has(self.topic) || self.type.contains('/msg/')",
        "the type of a topic is package/msg/Name, such as geometry_msgs/msg/Twist",
        ".type",
    ),
    (
        "!has(self.service) || self.type.contains('/srv/')",
        "the type of a service is package/srv/Name, such as std_srvs/srv/Trigger",
        ".type",
    ),
    (
        "!has(self.action) || self.type.contains('/action/')",
        "the type of an action is package/action/Name, such as nav2_msgs/action/NavigateToPose",
        ".type",
    ),
    length("lifespan", "10ms", "24h", required=False),
)
class Output(Model):
    """One interface to the robot: a topic that the robot reads, or a service or action between the workload and the robot."""

    topic: RosName | None = None
    """Fully qualified name of a topic that the robot subscribes to."""
    service: RosName | None = None
    """Fully qualified name of a service between the workload and the robot. Either side may be the server; with gate
    kind Mux, only the robot."""
    action: RosName | None = None
    """Fully qualified name of an action between the workload and the robot. Either side may be the server; with gate
    kind Mux, only the robot."""
    type: str = matching(ROS_TYPE_PATTERN, ROS_TYPE_MESSAGE, max_length=256)
    """ROS type, such as geometry_msgs/msg/Twist."""
    lifespan: Duration | None = None
    """How long a command stays valid if the robot has not received it: about one period of the output. Then the writer
    in the instance deletes it, so that a standby does not deliver old commands when the gate opens for it. Applies to
    the messages of a topic, the requests of a service, and the goals and cancellations of an action. Does not apply to
    replies, to the pods of a workloadRef, or to containers with a DDS profile file of their own, and not with gate
    kind Mux, which never forwards a command from before the gate was open for its writer. A latched topic
    (durability transient local) needs a long lifespan. Default: 100ms for a topic, or gate.reflex.deadline if that is
    shorter; 1s for a service or an action."""

    @property
    def name(self) -> str:
        """The name of the topic, service or action."""
        return self.topic or self.service or self.action or ""

    def valid_for(self, reflex: Reflex | None) -> float:
        """Return how long a command stays valid, in seconds.

        The deadline of the reflex is longer than the period of the topics, so a longer lifespan is never needed for one.
        """
        if self.lifespan is not None:
            return seconds(self.lifespan)
        if not self.topic:
            return seconds(REQUEST_LIFESPAN)
        return min(seconds(TOPIC_LIFESPAN), seconds(reflex.deadline) if reflex else float("inf"))


class WorkloadReference(Model):
    """An existing Deployment or StatefulSet whose pods are protected. Understudy does not change it; it only labels its pods."""

    kind: Literal["Deployment", "StatefulSet"]
    """Deployment or StatefulSet (apps/v1), with one replica."""
    name: ObjectName
    """Name of the Deployment or StatefulSet, in the same namespace."""


SERVER_PATTERN = r"^[A-Za-z0-9]([-A-Za-z0-9.]*[A-Za-z0-9])?:[1-9][0-9]{0,4}$"


@with_rules(
    ("self.mode != 'External' || has(self.server)", "server is required if mode is External", ".server"),
    ("self.mode == 'External' || !has(self.server)", "server is allowed only if mode is External", ".server"),
)
class Discovery(Model):
    """How the nodes of this robot's ROS graph find each other."""

    mode: Literal["Managed", "External", "Multicast"] = "Managed"
    """Managed: Understudy runs a Fast DDS discovery server for this robot. External: nodes use the discovery server
    named in the field server. Multicast: nodes use DDS simple discovery; the pod network must forward multicast, which
    most do not."""
    server: str | None = matching(
        SERVER_PATTERN, "write host:port, such as 10.0.0.7:11811", default=None, max_length=261
    )
    """Address of an existing discovery server, as host:port. Only for mode External."""


@with_rules(
    (
        "self.domainId != 2",
        "domainId 2 is not allowed, because its own ports (7900 to 8149) overlap the ports that the gate controls: "
        "use another domain",
        ".domainId",
    ),
)
class Ros(Model):
    """The robot's ROS graph."""

    domain_id: int = Field(default=0, ge=0, le=101)
    """ROS_DOMAIN_ID of this robot's graph. 2 is not allowed, because its ports overlap those of the gate."""
    discovery: Discovery = Field(default_factory=Discovery)
    """How the nodes of the graph find each other."""


@with_rules(length("deadline", "20ms", "10s"))
class Reflex(Model):
    """DDS exclusive ownership in addition to the gate: the robot's own reader switches to the standby without the control plane."""

    deadline: Duration = "100ms"
    """The robot's DataReader (with gate kind Mux, the mux) switches to the standby when it has received nothing from the
    active instance for this long. Must be longer than the longest gap between outputs without a failure. On a machine
    with busy cores, that gap may be longer than 100ms."""
    accept: list[RosName] = Field(default_factory=list, max_length=24)
    """Outputs that may switch independently of each other. If there are several outputs, or a service or action, list
    all of them here to accept that. Otherwise the operator refuses the workload (condition Accepted). Not needed with
    gate kind Mux, where all outputs switch at once."""


@with_rules(
    (
        "has(self.namespaceSelector) || has(self.podSelector)",
        "a peer needs a namespaceSelector, a podSelector or both",
    ),
)
class GatePeer(Model):
    """Pods, as the peer of a NetworkPolicy selects them."""

    namespace_selector: LabelSelector | None = None
    """Labels of the namespaces whose pods are meant. Empty: all namespaces. Absent: the workload's own namespace."""
    pod_selector: LabelSelector | None = None
    """Labels of the pods. Absent or empty: all pods of these namespaces."""


@with_rules(length("after", "20ms", "1h"))
class OnBoard(Model):
    """An instance at the robot that Understudy does not run, such as a container of the robot's pod or a process of its computer.

    It always runs and sends on all outputs. The mux forwards it only while nobody else sends.
    """

    name: ObjectName = "on-board"
    """Name of the instance. Set the environment variable UNDERSTUDY_POD of its processes to it. No pod may have this name."""
    after: Duration = "1s"
    """How long the active instance must be silent on an output that is a topic, or no instance active, before the mux
    forwards this one. Must be longer than the longest gap between outputs without a failure. Set it longer than a recovery by a
    standby of an Executing pool, so that this instance drives only if the cluster cannot be reached."""


class MuxSettings(Model):
    """Settings of the mux."""

    on_board: OnBoard | None = None
    """The instance that drives the robot while the link to the cluster is down. Absent: then nobody does. See docs/mux.md."""
    allowed_nodes: list[RosName] = Field(default_factory=list, max_length=16)
    """Nodes that may command the robot beside the mux, such as one for teleoperation, by their full names (/joy_teleop).
    The mux does not report them as writers that bypass it, and nothing keeps them from the robot while an instance
    commands it too. Restart the mux after a change."""


@with_rules(
    (
        "!has(self.mux) || (has(self.kind) && self.kind == 'Mux')",
        "mux is allowed only with kind Mux",
        ".mux",
    ),
)
class Gate(Model):
    """The gate, which decides which instance can reach the robot."""

    kind: Literal["NetworkPolicy", "Mux"] = "NetworkPolicy"
    """Kind of gate. NetworkPolicy: NetworkPolicies let only the pods for which the gate is open send to the ports at
    which the robot reads the outputs (the gated ports). The cluster's network plugin must enforce them. Mux: no
    instance can reach the robot's nodes, and the process understudy-mux beside them forwards the outputs of the one for
    which the gate is open. It needs no NetworkPolicies, and the robot's nodes need no DDS profile."""
    robots: list[Cidr] = Field(default_factory=list, max_length=16)
    """CIDRs of the robot and other peers outside the cluster. They must not include pod addresses: pods in these ranges
    could bypass the gate."""
    peers: list[GatePeer] = Field(default_factory=list, max_length=16)
    """Pods that the workload's instances and its discovery server may exchange packets with, such as those of a robot
    in another namespace. Empty: the pods of the workload's own namespace. To allow an instance more, such as a database
    or the Internet, write a NetworkPolicy of your own; it must not include UDP to the gated ports (7950 to 8149)."""
    reflex: Reflex | None = None
    """Reflex: if the active instance falls silent, a standby of an Executing pool takes over before the monitor acts. With
    kind NetworkPolicy, the gate is also open for that standby, and by DDS exclusive ownership the robot's own DataReaders
    switch to it. With kind Mux, the mux switches. Absent: only the monitor switches. See docs/reflex.md."""
    mux: MuxSettings | None = None
    """Settings of the mux. Only with kind Mux."""

    @property
    def is_at_robot(self) -> bool:
        """Whether a process beside the robot forwards the outputs, so that the network need not keep instances away."""
        return self.kind == "Mux"

    @property
    def on_board(self) -> OnBoard | None:
        """The instance at the robot; None if there is none."""
        return self.mux.on_board if self.mux is not None else None

    @property
    def readers_choose(self) -> bool:
        """Whether the robot's own readers choose between two instances, by the strength of their writers."""
        return self.reflex is not None and not self.is_at_robot


class MonitorSettings(Model):
    """Settings of the workload's monitor pod."""

    image: str | None = Field(default=None, min_length=1, max_length=512)
    """Image of the monitor. Set it if the default image does not contain your message types."""
    resources: UnknownContent | None = None
    """Resource requests and limits of the monitor container, as in a pod. Whoever sets them needs the right to create
    pods. Absent: the memory limit of the chart (monitors.memoryLimit). If spec.blackBox.memory and twice
    spec.state.maxBytes of the policy are half of it or more, they are added to it, up to a maximum
    (monitors.maxMemoryLimit); the condition MemorySufficient reports that."""
    diagnostics: bool = False
    """Publish the state of the workload on /diagnostics, every second and immediately when its level changes, for ROS
    tools. Health trees ignore these messages. See docs/ros-tools.md."""
    snapshots: bool = False
    """Publish the live health tree in the namespace /understudy, for the tools of py_trees_ros. The monitor's image
    must contain py_trees_ros_interfaces. See docs/ros-tools.md."""


@with_rules(
    (
        "(self.onRecovery == 'Procedure') == has(self.procedure)",
        "procedure is required if onRecovery is Procedure, and allowed only then",
        ".procedure",
    ),
)
class Dependency(Model):
    """A workload that this one depends on, and what to do here after that workload was recovered."""

    name: ObjectName
    """Name of the RobotWorkload that this one depends on, in the same namespace."""
    on_recovery: Literal["Nothing", "Reinitialize", "Restart", "Procedure"] = "Nothing"
    """What to do with the active instance of this workload after the dependency was recovered. Nothing: the application
    handles it. Reinitialize: run bringUp again behind a closed gate. Restart: replace the pod, as the strategy Restart
    does. Procedure: run the field procedure behind a closed gate."""
    procedure: Procedure | None = None
    """Procedure that runs on the active instance. Only for onRecovery Procedure."""
    notice_within: Duration = "300ms"
    """When this workload fails, the monitor waits this long for a failure of the dependency to be detected. If there is
    none, it then acts. Increase the time if the dependency's timeouts are longer than this workload's. 0s: act
    immediately."""
    settle_within: Duration = "10s"
    """If the dependency failed first: how long this workload may take to become healthy by itself after the dependency
    is healthy again. Then the monitor recovers this workload."""
    wait_for: Duration = "2m"
    """If the dependency failed first: maximum time that the monitor waits, from the failure of this workload. Then it
    recovers this workload even if the dependency has not recovered."""


@with_rules(
    (
        "has(self.template) != has(self.workloadRef)",
        "give exactly one of template (Understudy creates the pods) and workloadRef (an existing Deployment or "
        "StatefulSet)",
    ),
    (
        "has(self.template) == has(oldSelf.template)",
        "template cannot be replaced by workloadRef, or workloadRef by template: delete the "
        "RobotWorkload and create it again",
    ),
    *(
        (
            f"self.outputs.all(a, !has(a.{kind}) || self.outputs.exists_one(b, has(b.{kind}) && b.{kind} == a.{kind}))",
            f"outputs contains the same {kind} twice",
            ".outputs",
        )
        for kind in ("topic", "service", "action")
    ),
    (
        "(has(self.gate) && has(self.gate.reflex)) == (has(oldSelf.gate) && has(oldSelf.gate.reflex)) && "
        "(!has(self.gate) || !has(self.gate.reflex) || self.gate.reflex.deadline == oldSelf.gate.reflex.deadline)",
        "gate.reflex and its deadline cannot be changed: running pods and the robot's processes have "
        "already read the old value and would not match the new one. Delete the RobotWorkload, create "
        "it again and restart the robot's processes",
        ".gate",
    ),
    (
        "(has(self.gate) ? self.gate.kind : 'NetworkPolicy') == (has(oldSelf.gate) ? oldSelf.gate.kind : 'NetworkPolicy')",
        "gate.kind cannot be changed: running pods and the robot's processes are set up for the old one. Delete the "
        "RobotWorkload and create it again",
        ".gate",
    ),
    (
        "!has(self.template) || !has(self.template.spec.hostNetwork) || !self.template.spec.hostNetwork || "
        "(has(self.gate) && self.gate.kind == 'Mux')",
        "template.spec.hostNetwork needs gate.kind Mux, because NetworkPolicies do not apply to a pod in its node's network",
        ".template",
    ),
    unique("tasks", "action", "tasks contains the same action twice"),
    (
        "!has(self.tasks) || self.tasks.all(t, !self.outputs.exists(o, has(o.action) && o.action == t.action))",
        "an action belongs either to tasks (the workload serves it, and clients keep their goals) or to "
        "outputs (the robot serves it), not to both",
        ".tasks",
    ),
    unique("dependsOn", "name", "dependsOn contains the same workload twice"),
    (
        "!has(self.dependsOn) || has(self.bringUp) || self.dependsOn.all(d, d.onRecovery != 'Reinitialize')",
        "onRecovery Reinitialize runs bringUp, which is missing: set spec.bringUp, or use Procedure or Restart",
        ".dependsOn",
    ),
)
class RobotWorkloadSpec(Model):
    """One application of one robot."""

    template: UnknownContent | None = Field(default=None, json_schema_extra=pod_template(any_network=True))
    """Pod template, as in a Deployment: metadata.labels, metadata.annotations and spec. Understudy creates the pod from
    it, with a ReplicaSet of one replica."""
    workload_ref: WorkloadReference | None = None
    """Existing Deployment or StatefulSet to protect, instead of a template."""
    ros: Ros = Field(default_factory=Ros)
    """The robot's ROS graph."""
    outputs: list[Output] = Field(min_length=1, max_length=24)
    """Every topic that the robot subscribes to, and every service and action between the workload and the robot. The
    gate controls all of them, and nothing else. What it guarantees: docs/explanation/guarantees.md."""
    tasks: list[Task] = Field(default_factory=list, max_length=8)
    """Actions that the workload serves. When another instance takes over, Understudy handles their goals as onFailover
    says."""
    bring_up: Procedure | None = None
    """Procedure (a behaviour tree) that makes a started instance control the robot, such as lifecycle transitions. It
    runs on the first instance, on the standbys of Executing pools, and in a recovery after state was restored. Absent:
    the application must control the robot without it."""
    depends_on: list[Dependency] = Field(default_factory=list, max_length=8)
    """Workloads that this one needs in order to work. If one of them may have caused a failure of this workload, the
    monitor first waits for its recovery (noticeWithin, settleWithin, waitFor). See docs/dependencies.md."""
    failure_policy_ref: LocalReference
    """The FailurePolicy that protects this workload."""
    pool_priority: int = Field(default=0, ge=-1000, le=1000)
    """Priority of this workload when several workloads wait for a pod of a shared pool (readiness Uninitialized). The
    highest number gets a pod first, and among equals the workload that has waited longest. See docs/waiting.md."""
    gate: Gate = Field(default_factory=Gate)
    """The gate, which decides which instance can reach the robot."""
    draining: Draining = Field(default_factory=Draining)
    """What happens to the active instance while its node is drained."""
    monitor: MonitorSettings = Field(default_factory=MonitorSettings)
    """Settings of the workload's monitor."""
    pause: Pause | None = None
    """Maintenance mode. While this field is set, the monitor watches the workload and takes no action: it starts no
    recovery and no planned switchover, and sends no safe command (spec.safety of the policy). A recovery in progress is
    finished first. Then the gate stays as it is. See docs/limits.md."""


class Parts(Model):
    """The four parts of a recovery in seconds (equation 1 of the paper)."""

    detection: float
    """From the last healthy output to the detection of the failure, in seconds."""
    cluster: float
    """Time to get a pod (find, claim or create it) and to switch the gate, in seconds."""
    startup: float
    """Time to start the application's processes, in seconds."""
    reinitialization: float
    """From the start of the processes until the outputs are ready, in seconds."""


class Moments(Model):
    """Time of each step of a recovery, RFC 3339 with microseconds. Absent: the recovery did not reach the step."""

    last_healthy: Time | None = None
    """When the last healthy output before the failure arrived."""
    detected: Time | None = None
    """When the failure was detected."""
    held: Time | None = None
    """When the recovery was deferred because the policy's budget was used up. The failed instance was fenced (denied
    access to the robot), and nothing else was done."""
    released: Time | None = None
    """When the deferred recovery continued, because the budget allowed it again or a user resumed the workload."""
    decided: Time | None = None
    """When the last strategy was chosen: the one that succeeded, if any did."""
    queued: Time | None = None
    """When the recovery began to wait for a pod of a shared pool."""
    last_output: Time | None = None
    """For a planned switchover: when the last output of the previous instance arrived through the gate."""
    fenced: Time | None = None
    """When the gate had closed for the failed pod, or when the monitor last heard it, if that was later."""
    claimed: Time | None = None
    """When a pod of a shared pool was claimed (taken for this workload)."""
    started: Time | None = None
    """When the understudy's processes were running."""
    ready: Time | None = None
    """When the understudy published its outputs, still behind the gate."""
    routed: Time | None = None
    """When the understudy could reach the robot."""
    first_output: Time | None = None
    """When the first output of the understudy arrived through the gate."""
    verified: Time | None = None
    """When outputs of the understudy had arrived through the gate, and the monitor had heard no other known instance for
    one of its periods and a margin. Outputs that are topics count, and probe packets."""


class Attempt(Model):
    """One strategy that a recovery tried."""

    strategy: str
    """Restart, or Fallback/ and the readiness of the pool, such as Fallback/Initialized; with a reflex, Fallback/Executing
    (reflex). If the recovery follows one of a dependency, also Reinitialize or Procedure."""
    pod: str = ""
    """Name of the understudy's pod."""
    result: Literal["Verified", "NotVerified", "NotAvailable"]
    """Verified: the monitor received outputs of the new instance, and of no other known one. NotVerified: not in time.
    NotAvailable: the strategy could not be tried."""
    message: ReportedText = ""
    """Reason for the result."""


class DependencyRecovery(Model):
    """A recovery of a workload that this one depends on."""

    name: str
    """The RobotWorkload."""
    recovery: str
    """Id of the dependency's recovery. Empty if the dependency had none."""


class Recovery(Model):
    """A recovery, or a planned switchover (change of the active instance without a failure)."""

    id: str
    """Identifies the recovery. The id stays the same if the monitor restarts."""
    number: int = 0
    """Number of this recovery, counted from 1 for each workload."""
    reason: ReportedText
    """What failed, such as a leaf of the health tree or the pod, or why the switchover was planned."""
    result: Literal["Running", "Recovered", "Failed"]
    """Running, Recovered or Failed."""
    strategy: str = ""
    """The strategy that recovered the workload."""
    from_pod: str = ""
    """The pod that failed or was replaced."""
    to_pod: str = ""
    """The pod that took over."""
    epoch: int = 0
    """Epoch of the gate (the number of its last commit) after the recovery."""
    recovery_seconds: float | None = None
    """Sum of the four parts: seconds from the last healthy output until the understudy (the instance that took over)
    could reach the robot. The wait for a pod of a shared pool (from moments.queued) is included. The time for which the
    budget deferred the recovery (from moments.held to moments.released) is not."""
    parts: Parts | None = None
    """The four parts of the recovery time, in seconds."""
    moments: Moments = Field(default_factory=Moments)
    """Time of each step."""
    attempts: list[Attempt] = Field(default_factory=list)
    """The strategies that were tried, in order."""
    planned: bool = False
    """True for a planned switchover: a user requested it, the node is drained, or the workload is degraded."""
    switchover: Kind | None = None
    """For a planned switchover: why it was done. Failover or Failback: a user requested it. Drain: the node is drained.
    Absent if the workload was degraded."""
    follows: list[DependencyRecovery] | None = Field(default=None, max_length=8)
    """Recoveries of dependencies that caused this one (spec.dependsOn[].onRecovery). Absent if this workload itself
    failed."""
    resumed: bool = False
    """True if a new monitor completed a recovery that an earlier monitor had begun."""
    state: list[RestoredState] = Field(default_factory=list)
    """For each item of kept state: whether it was restored, how old it was, and why it was not restored."""


class GateStatus(Model):
    """State of the gate, which decides which instance can reach the robot."""

    epoch: int = 0
    """Number of the gate's last commit. It increases by one whenever the gate closes or opens for another pod. A change
    that was decided with an older epoch is refused, for example from a monitor that was replaced. ROS messages do not
    carry the epoch."""
    active: str = ""
    """The pod for which the gate is open. Empty if the gate is closed."""


class MonitorStatus(Model):
    """The monitor that wrote this status."""

    version: str = ""
    """Understudy version of the monitor."""
    image: str = ""
    """Image of the monitor."""
    agent_protocol: int | None = None
    """Newest version of the protocol between monitors and agents that the image knows. Absent before version 0.3."""


class RobotWorkloadStatus(Model):
    """Observed state. The operator and the monitor each apply their own fields."""

    observed_generation: int | None = None
    """Generation of the spec that was last reconciled."""
    active: str | None = None
    """The pod that controls the robot."""
    health: Health | None = None
    """Unknown, Starting, Healthy, Degraded, Failed or Recovering."""
    failing_since: Time | None = None
    """Time of the last healthy output, after which the current failure began. Absent if there is no failure."""
    standby: str | None = None
    """Readiness level of the standbys (instances that wait to take over), and how many of them could take over now."""
    strategy: str | None = None
    """The strategy that would be used if the workload failed now."""
    stocked: list[str] | None = Field(
        default=None, max_length=STOCKED_MOST, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The policy's shared pools (readiness Uninitialized) in which a pod is free for this workload now."""
    strategies: str | None = None
    """Summary of the strategies in order, with their pools. If Understudy chose the order, the condition
    StrategiesChosen explains it."""
    situation: SituationStatus | None = None
    """The policy's situation that currently applies. Absent if none applies. The condition SituationCovered says
    whether its strategies are in effect."""
    recovery_count: int | None = None
    """Number of recoveries and planned switchovers since the workload was created."""
    last_recovery_time: Time | None = None
    """When the last recovery ended."""
    spent: list[Time] | None = Field(
        default=None, max_length=MOST_COUNTED, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """Start times of the recoveries that count against the policy's limits.budget, oldest first. Recoveries that began
    before the time in the annotation understudy.dev/resumed do not count."""
    gate: GateStatus | None = None
    """State of the gate, which decides which instance can reach the robot."""
    monitor: MonitorStatus | None = None
    """The monitor that wrote this status. Absent if the monitor is older than 0.2.0."""
    switchover: SwitchoverStatus | None = None
    """The last planned switchover that a user requested or a drain caused, or the one in progress. A planned switchover
    of a degraded instance is only in recoveries."""
    recoveries: list[Recovery] | None = Field(
        default=None, max_length=10, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The last ten recoveries and planned switchovers, newest first."""
    tasks: list[TaskStatus] | None = Field(
        default=None, max_length=8, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The tasks and their goals."""
    dependencies: list[DependencyRecovery] | None = Field(
        default=None,
        max_length=8,
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    """For each dependency, its last recovery to which this workload has reacted (spec.dependsOn[].onRecovery)."""
    kept: str | None = None
    """Summary of the kept state of the healthy instance."""
    state: list[KeptStatus] | None = Field(
        default=None, max_length=64, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The items of kept state, with their age."""
    conditions: Conditions | None = None
    """Each is True if the following holds. Ready: Accepted, Reconciled and Protected are. Accepted: the spec and the
    policy are valid. Reconciled: all objects match the spec. Protected: the policy's first strategy could run now.
    StrategiesChosen (if the policy has a strategy Auto): the chosen order meets the policy's spec.requirements; the
    message explains it. SituationCovered (if the policy has situations): the strategies of the current situation are
    in effect; False until a pod for its first strategy is ready. MemorySufficient (if the policy lets the monitor keep
    much): the monitor's memory limit covers that. PolicyMapSufficient (only if it is False): the gate needs at most 70
    % of Cilium's policy map. Monitored: the monitor watches every topic of the health tree. Healthy: the health tree
    succeeds. DependenciesResolved (if spec.dependsOn is set): the workloads exist, and there is no cycle.
    DependencyFailed: the workload fails, and the monitor waits because a dependency may have caused it. Degraded: the
    health tree succeeds, and the stricter tree of the policy's spec.degraded fails. Resized: the active pod has the
    resources that the policy sets for a degraded workload. GateEnforced: of the probe packets to the monitor, only
    those of the pods for which the gate is open (the active pod and, with a reflex, one standby) arrive, the robot
    reads no output topic at a port outside the gate, and no agent reports a network interface besides that of the pod
    network. SoleDriver: the monitor hears no instance that the gate does not let through, by the messages on all
    topics of spec.outputs and by probe packets; Unknown if a sender is no known instance, or if an instance that drove
    before may still call a service or an action, and nothing shows whether it does. OutputsRead: the robot reads every
    topic of spec.outputs at gated ports. Recovering: a recovery is in progress. Paused: spec.pause is in effect.
    WithinBudget (if the policy has limits.budget): the budget allows another recovery. BroughtUp: bringUp and the
    pools' initializations have succeeded on every instance. Reflex (if spec.gate.reflex is set): the gate is also open
    for a standby, so that the robot's DataReaders switch to it if the active instance falls silent. Draining: the
    active pod's node is being drained, and evictions wait until an instance on another node has taken over.
    TasksProxied (if spec.tasks is set): the proxy serves all tasks. StateKept: everything in the policy's spec.state
    is kept. StateRestored: the last instance that took over received all of it."""
