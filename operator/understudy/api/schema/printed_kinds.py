"""The three kinds as Kubernetes shows them: names, printed columns, subresources and rules for the whole object."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.api.base import Model
from understudy.api.kinds.failure_policy import FailurePolicySpec, FailurePolicyStatus
from understudy.api.kinds.fallback_pool import FallbackPoolSpec, FallbackPoolStatus
from understudy.api.kinds.robot_workload import RobotWorkloadSpec, RobotWorkloadStatus

LONGEST_NAME = 48
"""Names of objects and labels derived from a workload's or pool's name must fit 63 characters; the longest ending has 15."""

NAME_PATTERN = r"^[a-z]([-a-z0-9]*[a-z0-9])?$"
"""A name from which Services can be named (RFC 1035 labels)."""


@dataclass(frozen=True)
class Column:
    """A column of ``kubectl get``."""

    name: str
    path: str
    description: str
    type: str = "string"
    wide: bool = False
    """Whether it is only in ``-o wide``."""


@dataclass(frozen=True)
class Kind:
    """A kind of ours."""

    name: str
    plural: str
    short: str
    description: str
    spec: type[Model]
    status: type[Model]
    columns: tuple[Column, ...]
    rules: tuple[tuple[str, str, str], ...] = ()
    scales: bool = False

    @property
    def singular(self) -> str:
        """The kind in lower case."""
        return self.name.lower()


AGE = Column("Age", ".metadata.creationTimestamp", "Since when it exists.", "date")

_SHORT_NAME = (
    (
        f"size(self.metadata.name) <= {LONGEST_NAME}",
        f"metadata.name is longer than {LONGEST_NAME} characters: names of pods, policies and labels are made from it and must fit 63",
        ".metadata.name",
    ),
    (
        f"self.metadata.name.matches('{NAME_PATTERN}')",
        "metadata.name must begin with a letter and have only lower-case letters, digits and dashes: a Service is named after it",
        ".metadata.name",
    ),
)

_NOT_ITSELF = (
    "!has(self.spec.dependsOn) || self.spec.dependsOn.all(d, d.name != self.metadata.name)",
    "dependsOn names this workload itself; name the ones that it depends on",
    ".spec.dependsOn",
)

KINDS = (
    Kind(
        name="RobotWorkload",
        plural="robotworkloads",
        short="rw",
        description="One application of one robot: its pods, its ROS graph, what it sends to the robot, and the policy that protects it.",
        spec=RobotWorkloadSpec,
        status=RobotWorkloadStatus,
        columns=(
            Column("Active", ".status.active", "The pod in control of the robot."),
            Column("Health", ".status.health", "Unknown, Starting, Healthy, Degraded, Failed or Recovering."),
            Column("Standby", ".status.standby", "Readiness of the standby, and how many of how many are ready."),
            Column("Strategy", ".status.strategy", "The strategy that would be used if it failed now."),
            Column("Recoveries", ".status.recoveryCount", "Recoveries since it was created.", "integer"),
            Column("Last", ".status.lastRecoveryTime", "Time since the last recovery.", "date"),
            Column("Order", ".status.strategies", "The strategies in order, with their pools.", wide=True),
            Column("Situation", ".status.situation.name", "The situation that it is in, by its policy.", wide=True),
            Column("Kept", ".status.kept", "What is kept of a healthy instance.", wide=True),
            Column("Taken", ".status.state[0].takenAt", "How old the first of it is.", "date", wide=True),
            AGE,
        ),
        rules=(*_SHORT_NAME, _NOT_ITSELF),
    ),
    Kind(
        name="FailurePolicy",
        plural="failurepolicies",
        short="fp",
        description="What healthy means for a RobotWorkload, and what is done, in which order, when it isn't.",
        spec=FailurePolicySpec,
        status=FailurePolicyStatus,
        columns=(
            Column(
                "Accepted",
                '.status.conditions[?(@.type=="Accepted")].status',
                "Whether it was understood; see the condition's message.",
            ),
            Column("Workloads", ".status.workloads", "How many RobotWorkloads use it.", "integer"),
            Column("Strategies", ".status.strategies", "The strategies in short, in order."),
            AGE,
        ),
    ),
    Kind(
        name="FallbackPool",
        plural="fallbackpools",
        short="fbp",
        description="A warm pool of understudies: how many, at which readiness, for which RobotWorkloads.",
        spec=FallbackPoolSpec,
        status=FallbackPoolStatus,
        columns=(
            Column("Readiness", ".spec.readiness", "Uninitialized, Initialized or Executing."),
            Column("Desired", ".status.desired", "Pods that should exist.", "integer"),
            Column("Ready", ".status.ready", "Pods that could take over now.", "integer"),
            Column("Claimed", ".status.claimed", "Pods of this pool that drive a robot.", "integer"),
            Column("Waiting", ".status.waiting", "Workloads that wait for a pod of it.", "integer", wide=True),
            Column("Updated", ".status.updated", "Unclaimed pods of the present template.", "integer", wide=True),
            AGE,
        ),
        rules=_SHORT_NAME,
        scales=True,
    ),
)
