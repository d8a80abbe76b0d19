"""RobotWorkload: one application of one robot, its outputs to the robot, and the policy that protects it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from understudy.api.base import (
    DURATION_PATTERN,
    Duration,
    LocalReference,
    Model,
    ObjectName,
    RosName,
    matching,
    with_rules,
)
from understudy.api.conditions import Conditions, Time
from understudy.api.kinds.failure_policy import MOST_COUNTED
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
)
class Output(Model):
    """One interface to the robot: a topic that the robot reads, or a service or action between the workload and the robot."""

    topic: RosName | None = None
    """Fully qualified name of a topic that the robot subscribes to."""
    service: RosName | None = None
    """Fully qualified name of a service between the workload and the robot. Either side may be the server."""
    action: RosName | None = None
    """Fully qualified name of an action between the workload and the robot. Either side may be the server."""
    type: str = matching(ROS_TYPE_PATTERN, ROS_TYPE_MESSAGE, max_length=256)
    """ROS type, such as geometry_msgs/msg/Twist."""

    @property
    def name(self) -> str:
        """The name of the topic, service or action."""
        return self.topic or self.service or self.action or ""


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
    named in the field server. Multicast: nodes use DDS simple discovery. Most pod networks do not forward multicast."""
    server: str | None = matching(
        SERVER_PATTERN, "write host:port, such as 10.0.0.7:11811", default=None, max_length=261
    )
    """Address of an existing discovery server, as host:port. Only for mode External."""


@with_rules(
    (
        "self.domainId != 2",
        "domainId 2 cannot be gated, because its own ports (7900 to 8149) overlap the gated ports: use another domain",
        ".domainId",
    ),
)
class Ros(Model):
    """The robot's ROS graph."""

    domain_id: int = Field(default=0, ge=0, le=101)
    """ROS_DOMAIN_ID of this robot's graph. 2 is not allowed."""
    discovery: Discovery = Field(default_factory=Discovery)
    """How the nodes of the graph find each other."""


@with_rules(
    (
        f"!self.deadline.matches(r'{DURATION_PATTERN}') || (duration(self.deadline) >= duration('20ms') && "
        "duration(self.deadline) <= duration('10s'))",
        "deadline must be from 20ms to 10s",
        ".deadline",
    ),
)
class Reflex(Model):
    """DDS exclusive ownership in addition to the gate: the robot's own reader switches to the standby without the control plane."""

    deadline: Duration = "100ms"
    """The robot's reader switches to the standby when it has received nothing from the active instance for this long.
    Must be longer than the period of the outputs."""
    accept: list[RosName] = Field(default_factory=list, max_length=24)
    """Outputs that are allowed to switch independently of each other. A reflex for several outputs, or for outputs that
    include a service or action, is refused unless all of them are listed here."""


class Gate(Model):
    """Decides which instance can reach the robot."""

    kind: Literal["NetworkPolicy"] = "NetworkPolicy"
    """Kind of gate. NetworkPolicy: network policies open the robot's gated ports for one pod. The cluster's network
    plugin must enforce them."""
    robots: list[Cidr] = Field(default_factory=list, max_length=16)
    """CIDRs of robots and other peers outside the cluster. They must not include pod addresses: pods in these ranges
    could bypass the gate."""
    reflex: Reflex | None = None
    """Lets the robot's reader switch to an executing standby by itself, before the gate switches. Absent: only the gate
    switches."""


class MonitorSettings(Model):
    """Settings of the workload's monitor pod."""

    image: str | None = Field(default=None, min_length=1, max_length=512)
    """Image of the monitor. Set it if the default image does not contain your message types."""
    resources: dict[str, Any] | None = None
    """Resource requests and limits of the monitor container, as in a pod."""
    diagnostics: bool = False
    """Publish the state of the workload on /diagnostics, every second and immediately when its level changes, for ROS
    tools. Health trees ignore these messages. See docs/ros-tools.md."""
    snapshots: bool = False
    """Publish the live health tree below /understudy, for the tools of py_trees_ros. The monitor's image must contain
    py_trees_ros_interfaces. See docs/ros-tools.md."""


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
    does. Procedure: run the procedure below behind a closed gate."""
    procedure: Procedure | None = None
    """What to run on the active instance. Only for onRecovery Procedure."""
    notice_within: Duration = "300ms"
    """How long to wait before acting on a failure of this workload, so that a failure of the dependency that may have
    caused it can be detected first. Increase it if the dependency's timeouts are longer than this workload's. 0s: act
    immediately."""
    settle_within: Duration = "10s"
    """How long a failure of this workload that a failure of the dependency may have caused may continue after the
    dependency is healthy again. After this time the failure is acted on."""
    wait_for: Duration = "2m"
    """Maximum time to wait for the dependency to become healthy. After this time a failure of this workload is acted on
    even if the dependency has not recovered."""


@with_rules(
    (
        "has(self.template) != has(self.workloadRef)",
        "give exactly one of template (Understudy runs the pods) and workloadRef (an existing "
        "Deployment or StatefulSet)",
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
        "!has(self.tasks) || self.tasks.all(a, self.tasks.exists_one(b, b.action == a.action))",
        "tasks contains the same action twice",
        ".tasks",
    ),
    (
        "!has(self.tasks) || self.tasks.all(t, !self.outputs.exists(o, has(o.action) && o.action == t.action))",
        "an action belongs either to tasks (the workload serves it, and clients keep their goals) or to "
        "outputs (the robot serves it), not to both",
        ".tasks",
    ),
    (
        "!has(self.dependsOn) || self.dependsOn.all(a, self.dependsOn.exists_one(b, b.name == a.name))",
        "dependsOn contains the same workload twice",
        ".dependsOn",
    ),
    (
        "!has(self.dependsOn) || has(self.bringUp) || self.dependsOn.all(d, d.onRecovery != 'Reinitialize')",
        "onRecovery Reinitialize runs bringUp, which is missing: set spec.bringUp, or use Procedure or Restart",
        ".dependsOn",
    ),
)
class RobotWorkloadSpec(Model):
    """One application of one robot."""

    template: dict[str, Any] | None = Field(default=None, json_schema_extra=pod_template())
    """Pod template, as in a Deployment: metadata.labels, metadata.annotations and spec. Understudy runs the pods."""
    workload_ref: WorkloadReference | None = None
    """Existing Deployment or StatefulSet to protect, instead of a template."""
    ros: Ros = Field(default_factory=Ros)
    """The robot's ROS graph."""
    outputs: list[Output] = Field(min_length=1, max_length=24)
    """Every topic, service and action between the workload and the robot. All of them are gated: only the active
    instance can reach the robot."""
    tasks: list[Task] = Field(default_factory=list, max_length=8)
    """Actions that the workload serves and whose goals survive a failover."""
    bring_up: Procedure | None = None
    """Procedure that makes a started instance drive the robot, such as lifecycle transitions. It runs on the first
    instance, on executing standbys, and during a failover after state was restored. Absent: the application starts
    driving without help."""
    depends_on: list[Dependency] = Field(default_factory=list, max_length=8)
    """Workloads that this one needs in order to work. A failure that one of them may have caused is not treated as a
    failure of this workload. See docs/dependencies.md."""
    failure_policy_ref: LocalReference
    """The FailurePolicy that protects this workload."""
    pool_priority: int = Field(default=0, ge=-1000, le=1000)
    """Priority of this workload when several workloads wait for a pod of a shared pool (Uninitialized). The highest
    number is served first. With equal priority, the workload that has waited longest is served first. See
    docs/waiting.md."""
    gate: Gate = Field(default_factory=Gate)
    """Decides which instance can reach the robot."""
    draining: Draining = Field(default_factory=Draining)
    """What happens to the active instance while its node is drained."""
    monitor: MonitorSettings = Field(default_factory=MonitorSettings)
    """Settings of the workload's monitor."""
    pause: Pause | None = None
    """Maintenance mode. While this field is set, the monitor watches the workload and takes no action: no recovery, no
    hand-over, no safe command. See docs/limits.md."""


class Parts(Model):
    """The four phases of a recovery in seconds (equation 1 of the paper)."""

    detection: float
    """From the last healthy output to the detection of the failure, in seconds."""
    cluster: float
    """Time for pods, claims and the gate, in seconds."""
    startup: float
    """Time to start the application's processes, in seconds."""
    reinitialization: float
    """From the start of the processes to outputs that are ready, in seconds."""


class Moments(Model):
    """Time of each step of a recovery, RFC 3339 with microseconds. Absent: the recovery did not reach the step."""

    last_healthy: Time | None = None
    """Last healthy output before the failure."""
    detected: Time | None = None
    """The health tree failed."""
    held: Time | None = None
    """The policy's budget was used up. The failed instance was fenced and nothing else was done."""
    released: Time | None = None
    """The budget allowed a recovery again, or a user resumed the workload."""
    decided: Time | None = None
    """The strategy that was verified in the end was chosen."""
    queued: Time | None = None
    """The recovery began to wait for a pod of a shared pool."""
    last_output: Time | None = None
    """For a planned switchover: last output of the previous instance that the gated readers received."""
    fenced: Time | None = None
    """The failed pod could no longer reach the robot."""
    claimed: Time | None = None
    """The understudy was claimed."""
    started: Time | None = None
    """The understudy's processes were running."""
    ready: Time | None = None
    """The understudy published its own outputs."""
    routed: Time | None = None
    """The understudy could reach the robot."""
    first_output: Time | None = None
    """The gated readers received the first output of the understudy."""
    verified: Time | None = None
    """The gated readers received outputs from the understudy and from no other instance."""


class Attempt(Model):
    """One strategy that a recovery tried."""

    strategy: str
    """Restart, or Fallback/ and the readiness of the pool, such as Fallback/Initialized; with a reflex, Fallback/Executing
    (reflex). After the recovery of another workload also Reinitialize or Procedure."""
    pod: str = ""
    """Name of the understudy's pod."""
    result: Literal["Verified", "NotVerified", "NotAvailable"]
    """Result of the attempt."""
    message: str = ""
    """Why."""


class DependencyRecovery(Model):
    """A recovery of a workload that this one depends on."""

    name: str
    """The RobotWorkload."""
    recovery: str
    """Id of the dependency's recovery. Empty if the dependency had none."""


class Recovery(Model):
    """One failure and the response to it."""

    id: str
    """Identifies the recovery. The id stays the same if the monitor restarts."""
    number: int = 0
    """Number of this recovery, counted from 1 for each workload."""
    reason: str
    """What failed, as reported by the health tree."""
    result: Literal["Running", "Recovered", "Failed"]
    """Running, Recovered or Failed."""
    strategy: str = ""
    """The strategy that recovered the workload."""
    from_pod: str = ""
    """The pod that failed."""
    to_pod: str = ""
    """The pod that took over."""
    epoch: int = 0
    """Epoch of the gate after the recovery."""
    recovery_seconds: float | None = None
    """Sum of the phases: seconds from the last healthy output to the moment when the understudy could reach the
    robot."""
    parts: Parts | None = None
    """The four phases of the recovery time."""
    moments: Moments = Field(default_factory=Moments)
    """Time of each step."""
    attempts: list[Attempt] = Field(default_factory=list)
    """The strategies that were tried, in order."""
    planned: bool = False
    """True if nothing failed: a hand-over at an idle moment (spec.degraded of the policy), or a planned switchover."""
    switchover: Kind | None = None
    """For a planned switchover: why it was done (Failover, Failback or Drain)."""
    follows: list[DependencyRecovery] | None = Field(default=None, max_length=8)
    """Recoveries of other workloads that this recovery followed, as configured in spec.dependsOn. Absent if this
    workload itself failed."""
    resumed: bool = False
    """True if a new monitor completed a recovery that an earlier monitor had begun."""
    state: list[RestoredState] = Field(default_factory=list)
    """What was restored and how old it was; what was not restored, and why."""


class GateStatus(Model):
    """The instance that can reach the robot."""

    epoch: int = 0
    """Increases by one with every change of control."""
    active: str = ""
    """The active pod. Empty if there is none."""


class MonitorStatus(Model):
    """The monitor that wrote this status."""

    version: str = ""
    """Understudy version of the monitor."""
    image: str = ""
    """Image of the monitor."""


class RobotWorkloadStatus(Model):
    """Observed state. The operator and the monitor each apply their own fields."""

    observed_generation: int | None = None
    """Generation of the spec that was last reconciled."""
    active: str | None = None
    """The pod that controls the robot."""
    health: Health | None = None
    """Unknown, Starting, Healthy, Degraded, Failed or Recovering."""
    failing_since: Time | None = None
    """Time of the last healthy output before the current failure. Absent if there is no failure."""
    standby: str | None = None
    """Readiness of the standbys, and how many of them are ready."""
    strategy: str | None = None
    """The strategy that would be used if the workload failed now."""
    stocked: list[str] | None = Field(
        default=None, max_length=STOCKED_MOST, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The policy's shared pools (Uninitialized) that have a pod that this workload could claim now."""
    strategies: str | None = None
    """The strategies in short form, in order, with their pools. If Understudy chose the order, the condition
    StrategiesChosen explains it."""
    situation: SituationStatus | None = None
    """The policy's situation that currently applies. Absent if none applies. The condition SituationCovered says
    whether its strategies are in effect."""
    recovery_count: int | None = None
    """Number of recoveries since the workload was created."""
    last_recovery_time: Time | None = None
    """When the last recovery ended."""
    spent: list[Time] | None = Field(
        default=None, max_length=MOST_COUNTED, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """Start times of the recoveries that count against the policy's limits.budget, oldest first. Recoveries before the
    time in the annotation understudy.dev/resumed do not count."""
    gate: GateStatus | None = None
    """The instance that can reach the robot."""
    monitor: MonitorStatus | None = None
    """The monitor that wrote this status. Absent if the monitor is older than 0.2.0."""
    switchover: SwitchoverStatus | None = None
    """The last planned switchover, or the one in progress."""
    recoveries: list[Recovery] | None = Field(
        default=None, max_length=10, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The last ten recoveries, newest first."""
    tasks: list[TaskStatus] | None = Field(
        default=None, max_length=8, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The tasks and their goals."""
    dependencies: list[DependencyRecovery] | None = Field(
        default=None,
        max_length=8,
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    """For each dependency, its last recovery that this workload has responded to as spec.dependsOn says."""
    kept: str | None = None
    """Summary of the state that is kept of a healthy instance."""
    state: list[KeptStatus] | None = Field(
        default=None, max_length=64, json_schema_extra={"x-kubernetes-list-type": "atomic"}
    )
    """The items of kept state, with their age."""
    conditions: Conditions | None = None
    """Accepted: the spec and the policy are valid. Reconciled: all objects exist. Protected: the first strategy could
    take over now. StrategiesChosen (if the policy has a strategy Auto): the order that was chosen, and why; False if it
    does not meet the policy's spec.requirements. SituationCovered (if the policy has situations): the strategies of the
    current situation are in effect; False until its first standby is ready. Monitored: the monitor watches every topic
    of the health tree. Healthy: the health tree succeeds. DependenciesResolved (if spec.dependsOn is set): the
    workloads exist, and there is no cycle. DependencyFailed: the workload fails, and the monitor waits because a
    dependency may have caused it. Degraded: the health tree succeeds, and the tree of spec.degraded fails. Resized: the
    active pod has the resources that the policy sets for a degraded workload. GateEnforced: packets show that only the
    active pod can reach the robot, and that the robot has no reader at a port without a gate. OutputsRead: the robot
    reads every topic of spec.outputs at gated ports. Recovering: a recovery is in progress. Paused: spec.pause is in
    effect. WithinBudget (if the policy has limits.budget): the budget allows another recovery. BroughtUp: bringUp and
    initializations have succeeded on every instance. Reflex: a standby may also send, so that the robot's readers can
    switch to it. Draining: the active pod's node is being drained; True while evictions wait for an understudy on
    another node. StateKept: everything that the policy lists is kept. StateRestored: the last instance that took over
    received all of it."""
