"""RobotWorkload: one application of one robot, what it sends to the robot and what protects it."""

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
    rules,
)
from understudy.api.conditions import Condition, Time
from understudy.api.kinds.failure_policy import MOST_COUNTED
from understudy.api.kinds.pause_spec import Pause
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.situation_spec import SituationStatus
from understudy.api.kinds.state_spec import KeptStatus, RestoredState
from understudy.api.kinds.switchover_spec import Draining, Kind, SwitchoverStatus
from understudy.api.kinds.task_spec import Task, TaskStatus
from understudy.api.ros_names import ROS_TYPE_MESSAGE, ROS_TYPE_PATTERN
from understudy.api.schema.pod_template import pod_template

STOCKED_MOST = 8
"""Most shared pools that a status names as having a pod for a workload."""

Health = Literal["Unknown", "Starting", "Healthy", "Degraded", "Failed", "Recovering"]

_BYTE = r"(25[0-5]|2[0-4][0-9]|1[0-9][0-9]|[1-9]?[0-9])"
CIDR_PATTERN = rf"^(({_BYTE}\.){{3}}{_BYTE}/([1-9]|[12][0-9]|3[0-2])|[0-9a-fA-F:]*:[0-9a-fA-F:]*/([1-9]|[1-9][0-9]|1[01][0-9]|12[0-8]))$"
CIDR_MESSAGE = "write addresses as a CIDR, such as 192.168.10.0/24 or 192.168.10.7/32; /0 would contain the pods too"

Cidr = Annotated[
    str, Field(pattern=CIDR_PATTERN, max_length=43, json_schema_extra=matching(CIDR_PATTERN, CIDR_MESSAGE))
]
"""A range of IP addresses outside the cluster."""


class Output(Model):
    """One thing that reaches the robot: a topic it reads, or a service or action that joins it to the workload."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
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
    }

    topic: RosName | None = Field(default=None, description="Topic that the robot subscribes to, fully qualified.")
    service: RosName | None = Field(
        default=None, description="Service between the workload and the robot, whichever of them serves it."
    )
    action: RosName | None = Field(
        default=None, description="Action between the workload and the robot, whichever of them serves it."
    )
    type: str = Field(
        pattern=ROS_TYPE_PATTERN,
        max_length=256,
        description="ROS type, such as geometry_msgs/msg/Twist.",
        json_schema_extra=matching(ROS_TYPE_PATTERN, ROS_TYPE_MESSAGE),
    )

    @property
    def name(self) -> str:
        """The topic's, service's or action's name."""
        return self.topic or self.service or self.action or ""


class WorkloadReference(Model):
    """An existing controller whose pods are protected. It is left untouched; its pods get labels."""

    kind: Literal["Deployment", "StatefulSet"] = Field(
        description="Deployment or StatefulSet (apps/v1), with one replica."
    )
    name: ObjectName = Field(description="Its name, in the same namespace.")


SERVER_PATTERN = r"^[A-Za-z0-9]([-A-Za-z0-9.]*[A-Za-z0-9])?:[1-9][0-9]{0,4}$"


class Discovery(Model):
    """How the nodes of this robot's ROS graph find each other."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            ("self.mode != 'External' || has(self.server)", "server is required where mode is External", ".server"),
            ("self.mode == 'External' || !has(self.server)", "server is only for mode External", ".server"),
        )
    }

    mode: Literal["Managed", "External", "Multicast"] = Field(
        default="Managed",
        description="Managed: Understudy runs a Fast DDS discovery server for this robot. External: use the one named in "
        "server. Multicast: DDS simple discovery; multicast doesn't cross most pod networks.",
    )
    server: str | None = Field(
        default=None,
        pattern=SERVER_PATTERN,
        max_length=261,
        description="host:port of an existing discovery server.",
        json_schema_extra=matching(SERVER_PATTERN, "write host:port, such as 10.0.0.7:11811"),
    )


class Ros(Model):
    """The robot's ROS graph."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.domainId != 2",
                "domainId 2 can't be gated: its own ports (7900 to 8149) overlap the gated ones; take another",
                ".domainId",
            ),
        )
    }

    domain_id: int = Field(default=0, ge=0, le=101, description="ROS_DOMAIN_ID of this robot's graph; not 2.")
    discovery: Discovery = Field(default_factory=Discovery, description="How nodes find each other.")


class Reflex(Model):
    """DDS exclusive ownership under the gate: the robot's own reader falls over to the standby, with no control plane."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                f"!self.deadline.matches(r'{DURATION_PATTERN}') || (duration(self.deadline) >= duration('20ms') && "
                "duration(self.deadline) <= duration('10s'))",
                "deadline is from 20ms to 10s",
                ".deadline",
            ),
        )
    }

    deadline: Duration = Field(
        default="100ms",
        description="The robot's reader takes the standby's messages when the instance in control was silent for this long. "
        "Longer than the period of the outputs.",
    )
    accept: list[RosName] = Field(
        default_factory=list,
        max_length=24,
        description="Outputs that fall over each by itself. A reflex with several outputs, or with a service or action among them, is "
        "refused unless all of them are named here.",
    )


class Gate(Model):
    """What decides whose outputs reach the robot."""

    kind: Literal["NetworkPolicy"] = Field(
        default="NetworkPolicy",
        description="NetworkPolicy: policies open the robot's gated ports for one pod. The cluster's network must enforce them.",
    )
    robots: list[Cidr] = Field(
        default_factory=list,
        max_length=16,
        description="CIDRs of robots (and of other peers) outside the cluster. Must not contain pod addresses, or the gate leaks.",
    )
    reflex: Reflex | None = Field(
        default=None,
        description="Have the robot's reader fall over to an executing standby by itself, before the gate is switched.",
    )


class MonitorSettings(Model):
    """The workload's monitor pod."""

    image: str | None = Field(
        default=None,
        min_length=1,
        max_length=512,
        description="Image of the monitor, where the operator's default lacks your message types.",
    )
    resources: dict[str, Any] | None = Field(
        default=None,
        description="Resource requests and limits of the monitor, as in a pod.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    diagnostics: bool = Field(
        default=False,
        description="Publish on /diagnostics how the workload is, every second and at once on a change of level, as ROS tools read it. "
        "No health tree takes it for evidence. See docs/ros-tools.md.",
    )
    snapshots: bool = Field(
        default=False,
        description="Publish the live health tree below /understudy, as the tools of py_trees_ros read it. The monitor's image must have "
        "py_trees_ros_interfaces. See docs/ros-tools.md.",
    )


class Dependency(Model):
    """Another workload without which this one can't work, and what is done here once that one was recovered."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "(self.onRecovery == 'Procedure') == has(self.procedure)",
                "procedure is required where onRecovery is Procedure, and only given there",
                ".procedure",
            ),
        )
    }

    name: ObjectName = Field(description="The RobotWorkload that this one depends on, in the same namespace.")
    on_recovery: Literal["Nothing", "Reinitialize", "Restart", "Procedure"] = Field(
        default="Nothing",
        description="What is done to this workload's instance in control once that one was recovered. Nothing: it copes by itself. "
        "Reinitialize: its bringUp is run again, behind a closed gate. Restart: its pod is replaced, as by the strategy. Procedure: what "
        "procedure says, behind a closed gate.",
    )
    procedure: Procedure | None = Field(
        default=None, description="What is done to the instance in control; for onRecovery Procedure."
    )
    notice_within: Duration = Field(
        default="300ms",
        description="A failure of this workload isn't acted on for so long, since what it may follow from is noticed a moment later. "
        "Longer where that one's timeouts are longer than this one's; 0s to act at once.",
    )
    settle_within: Duration = Field(
        default="10s",
        description="Once that one is healthy again, a failure of this workload that may follow from its failure has so long to pass.",
    )
    wait_for: Duration = Field(
        default="2m",
        description="A failure of this workload that may follow from that one's is acted on after so long all the same, though that one "
        "isn't healthy again.",
    )


class RobotWorkloadSpec(Model):
    """One application of one robot."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "has(self.template) != has(self.workloadRef)",
                "give exactly one of template (Understudy runs the pods) and workloadRef (an existing Deployment or StatefulSet)",
            ),
            (
                "has(self.template) == has(oldSelf.template)",
                "template and workloadRef can't be exchanged: delete the RobotWorkload and create it anew",
            ),
            *(
                (
                    f"self.outputs.all(a, !has(a.{kind}) || self.outputs.exists_one(b, has(b.{kind}) && b.{kind} == a.{kind}))",
                    f"outputs has the same {kind} twice",
                    ".outputs",
                )
                for kind in ("topic", "service", "action")
            ),
            (
                "(has(self.gate) && has(self.gate.reflex)) == (has(oldSelf.gate) && has(oldSelf.gate.reflex)) && "
                "(!has(self.gate) || !has(self.gate.reflex) || self.gate.reflex.deadline == oldSelf.gate.reflex.deadline)",
                "gate.reflex and its deadline can't be changed: the robot's processes and the pods that run have read theirs, and "
                "wouldn't hear each other. Delete the RobotWorkload, create it anew and restart the robot's processes",
                ".gate",
            ),
            (
                "!has(self.tasks) || self.tasks.all(a, self.tasks.exists_one(b, b.action == a.action))",
                "tasks has the same action twice",
                ".tasks",
            ),
            (
                "!has(self.tasks) || self.tasks.all(t, !self.outputs.exists(o, has(o.action) && o.action == t.action))",
                "an action is either among tasks (the workload serves it, clients keep their goals) or among outputs "
                "(the robot serves it)",
                ".tasks",
            ),
            (
                "!has(self.dependsOn) || self.dependsOn.all(a, self.dependsOn.exists_one(b, b.name == a.name))",
                "dependsOn has the same workload twice",
                ".dependsOn",
            ),
            (
                "!has(self.dependsOn) || has(self.bringUp) || self.dependsOn.all(d, d.onRecovery != 'Reinitialize')",
                "onRecovery Reinitialize runs bringUp again, and there is none: give spec.bringUp, or take Procedure or Restart",
                ".dependsOn",
            ),
        )
    }

    template: dict[str, Any] | None = Field(
        default=None,
        description="Pod template (as in a Deployment): metadata.labels, metadata.annotations and spec.",
        json_schema_extra=pod_template(),
    )
    workload_ref: WorkloadReference | None = Field(
        default=None, description="Existing Deployment or StatefulSet to protect instead of a template."
    )
    ros: Ros = Field(default_factory=Ros, description="The robot's ROS graph.")
    outputs: list[Output] = Field(
        min_length=1,
        max_length=24,
        description="Everything that reaches the robot. All of it is gated: only the instance in control gets through.",
    )
    tasks: list[Task] = Field(
        default_factory=list, max_length=8, description="Actions of the workload whose goals outlive a failover."
    )
    bring_up: Procedure | None = Field(
        default=None,
        description="What brings an instance from started to driving, such as lifecycle transitions. Run on the first instance, on "
        "executing standbys, and at a failover after the state was restored. Absent: the application does it by itself.",
    )
    depends_on: list[Dependency] = Field(
        default_factory=list,
        max_length=8,
        description="Workloads without which this one can't work. A failure that may follow from one of theirs isn't taken for its own. "
        "See docs/dependencies.md.",
    )
    failure_policy_ref: LocalReference = Field(description="The FailurePolicy that protects it.")
    pool_priority: int = Field(
        default=0,
        ge=-1000,
        le=1000,
        description="How critical it is that this workload gets a pod of a shared pool (Uninitialized) before others that wait for one: "
        "higher first; among equals, whoever has waited longest. See docs/waiting.md.",
    )
    gate: Gate = Field(default_factory=Gate, description="What decides whose outputs reach the robot.")
    draining: Draining = Field(
        default_factory=Draining, description="What becomes of the instance in control while its node is being drained."
    )
    monitor: MonitorSettings = Field(default_factory=MonitorSettings, description="The workload's monitor.")
    pause: Pause | None = Field(
        default=None,
        description="Maintenance: while it is there, the workload is watched, and nothing is done by itself: no recovery, no hand-over, no "
        "safe command. See docs/limits.md.",
    )


class Parts(Model):
    """The four parts of a recovery in seconds (equation 1 of the paper)."""

    detection: float = Field(description="From the last healthy output to the failure's detection, in seconds.")
    cluster: float = Field(description="Pods, claims and gate, in seconds.")
    startup: float = Field(description="Start of the application's processes, in seconds.")
    reinitialization: float = Field(description="From started to outputs ready, in seconds.")


class Moments(Model):
    """When each step of a recovery happened, RFC 3339 with microseconds. Absent where the step wasn't reached."""

    last_healthy: Time | None = Field(default=None, description="Last healthy output before the failure.")
    detected: Time | None = Field(default=None, description="The health tree failed.")
    held: Time | None = Field(default=None, description="The policy's budget was spent: no more than fencing was done.")
    released: Time | None = Field(default=None, description="There was budget again, or somebody said to go on.")
    decided: Time | None = Field(default=None, description="The strategy that verified was chosen.")
    queued: Time | None = Field(default=None, description="It began to wait for a pod of a shared pool.")
    last_output: Time | None = Field(
        default=None, description="Of a planned switchover: last output of the former instance at the gated readers."
    )
    fenced: Time | None = Field(default=None, description="The failed pod could no longer reach the robot.")
    claimed: Time | None = Field(default=None, description="The understudy was claimed.")
    started: Time | None = Field(default=None, description="The understudy's processes were up.")
    ready: Time | None = Field(default=None, description="The understudy's own outputs were flowing.")
    routed: Time | None = Field(default=None, description="The understudy could reach the robot.")
    first_output: Time | None = Field(default=None, description="First output of the understudy at the gated readers.")
    verified: Time | None = Field(default=None, description="Outputs seen from the understudy and from no other.")


class Attempt(Model):
    """One strategy that was tried in a recovery."""

    strategy: str = Field(
        description="Fallback/Executing, Fallback/Executing (reflex), Fallback/Initialized, Fallback/Uninitialized or Restart; after the "
        "recovery of another workload also Reinitialize or Procedure."
    )
    pod: str = Field(default="", description="The understudy.")
    result: Literal["Verified", "NotVerified", "NotAvailable"] = Field(description="How it ended.")
    message: str = Field(default="", description="Why.")


class DependencyRecovery(Model):
    """A recovery of a workload that this one depends on."""

    name: str = Field(description="The RobotWorkload.")
    recovery: str = Field(description="Id of its recovery; empty where it had none yet.")


class Recovery(Model):
    """One failure and what was done about it."""

    id: str = Field(description="Identifies the recovery; the same over a restart of the monitor.")
    number: int = Field(default=0, description="Counts the workload's recoveries from 1.")
    reason: str = Field(description="What failed, as the health tree said it.")
    result: Literal["Running", "Recovered", "Failed"] = Field(description="Running, Recovered or Failed.")
    strategy: str = Field(default="", description="The strategy that recovered it.")
    from_pod: str = Field(default="", description="The pod that failed.")
    to_pod: str = Field(default="", description="The pod that took over.")
    epoch: int = Field(default=0, description="Epoch of the gate after it.")
    recovery_seconds: float | None = Field(default=None, description="Sum of the parts: last healthy output to routed.")
    parts: Parts | None = Field(default=None, description="The four parts of the recovery time.")
    moments: Moments = Field(default_factory=Moments, description="When each step happened.")
    attempts: list[Attempt] = Field(default_factory=list, description="The strategies tried, in order.")
    planned: bool = Field(
        default=False,
        description="Whether it was no failure, but a hand-over at an idle moment (spec.degraded of the policy) or a switchover.",
    )
    switchover: Kind | None = Field(
        default=None, description="What for, where it was a planned switchover: Failover, Failback or Drain."
    )
    follows: list[DependencyRecovery] | None = Field(
        default=None,
        max_length=8,
        description="It was no failure of this workload, but what spec.dependsOn says is done after these recoveries of others.",
    )
    resumed: bool = Field(default=False, description="Whether a new monitor finished what an earlier one had begun.")
    state: list[RestoredState] = Field(
        default_factory=list,
        description="What became of the kept state: what was restored and how old it was, what was not and why.",
    )


class GateStatus(Model):
    """Who may reach the robot."""

    epoch: int = Field(default=0, description="Grows by one with every change of control.")
    active: str = Field(default="", description="The pod in control; empty while none is.")


class MonitorStatus(Model):
    """The monitor that wrote this status."""

    version: str = Field(default="", description="Its version of Understudy.")
    image: str = Field(default="", description="Its image.")


class RobotWorkloadStatus(Model):
    """What is so. The operator and the monitor each apply their own fields."""

    observed_generation: int | None = Field(
        default=None, description="Generation of the spec that was reconciled last."
    )
    active: str | None = Field(default=None, description="The pod in control of the robot.")
    health: Health | None = Field(
        default=None, description="Unknown, Starting, Healthy, Degraded, Failed or Recovering."
    )
    failing_since: Time | None = Field(
        default=None,
        description="The last healthy output before the failure that isn't over; absent while there is none.",
    )
    standby: str | None = Field(
        default=None, description="Readiness of the standby, and how many of how many are ready."
    )
    strategy: str | None = Field(default=None, description="The strategy that would be used if it failed now.")
    stocked: list[str] | None = Field(
        default=None,
        max_length=STOCKED_MOST,
        description="The shared pools of its policy (Uninitialized) that have a pod which it could claim.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    strategies: str | None = Field(
        default=None,
        description="The strategies in short, in order, with their pools. Why in this order, where they were chosen, the condition "
        "StrategiesChosen says.",
    )
    situation: SituationStatus | None = Field(
        default=None,
        description="Which of the policy's situations the robot is in; absent for none. Whether its strategies are in force, the condition "
        "SituationCovered says.",
    )
    recovery_count: int | None = Field(default=None, description="Recoveries since it was created.")
    last_recovery_time: Time | None = Field(default=None, description="When the last recovery ended.")
    spent: list[Time] | None = Field(
        default=None,
        max_length=MOST_COUNTED,
        description="When the recoveries began that count against limits.budget of the policy, oldest first. Those before the annotation "
        "understudy.dev/resumed don't.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    gate: GateStatus | None = Field(default=None, description="Who may reach the robot.")
    monitor: MonitorStatus | None = Field(
        default=None, description="The monitor that wrote this status; absent for one before 0.2.0."
    )
    switchover: SwitchoverStatus | None = Field(
        default=None, description="The last planned switchover, or the one that is under way."
    )
    recoveries: list[Recovery] | None = Field(
        default=None,
        max_length=10,
        description="The last ten recoveries, newest first.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    tasks: list[TaskStatus] | None = Field(
        default=None,
        max_length=8,
        description="The tasks and their goals.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    dependencies: list[DependencyRecovery] | None = Field(
        default=None,
        max_length=8,
        description="The last recovery of each workload that this one depends on after which was done here what spec.dependsOn says.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    kept: str | None = Field(default=None, description="What is kept of a healthy instance, in short.")
    state: list[KeptStatus] | None = Field(
        default=None,
        max_length=64,
        description="What is kept, and how old it is.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted: spec and policy can be followed. Reconciled: everything was built. Protected: the first strategy could "
        "take over now. StrategiesChosen, where the policy has Auto: which order was chosen, and why; False where it doesn't give what "
        "spec.requirements of the policy ask for. SituationCovered, where the policy has "
        "situations: the strategies of the present one are in force; False until its first standby is ready. "
        "Monitored: every topic of the health tree is watched. Healthy: the tree holds. "
        "DependenciesResolved, where spec.dependsOn names some: they are there, and none of them depends on this one in turn. "
        "DependencyFailed: it fails, and isn't acted on since that may follow from the failure of one that it depends on. "
        "Degraded: it holds, and that of spec.degraded doesn't. Resized: the pod in control has what the policy gives it then. "
        "GateEnforced: packets show that only the pod in control gets through, and no reader of the robot listens where no gate is. "
        "OutputsRead: each topic of spec.outputs is read on the robot's side, at gated ports. "
        "Recovering: a failure is being dealt with. Paused: "
        "spec.pause is in force. WithinBudget, where the policy has limits.budget: recoveries are left. BroughtUp: "
        "bringUp and initializations have "
        "succeeded on every instance. Reflex: a standby is let through, so that the "
        "robot's readers can fall over to it. Draining: the node of the pod in control is to be emptied; True while "
        "evictions wait for an understudy on another one. StateKept: all that the policy keeps is kept. StateRestored: the last instance "
        "that took over was given all of it.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )
