"""The three kinds as Kubernetes shows them: names, printed columns, subresources and rules for the whole object."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.api.base import Model
from understudy.api.kinds.failure_policy import FailurePolicySpec, FailurePolicyStatus
from understudy.api.kinds.fallback_pool import FallbackPoolSpec, FallbackPoolStatus
from understudy.api.kinds.robot_workload import RobotWorkloadSpec, RobotWorkloadStatus

LONGEST_NAME = 48
"""Maximum length of a workload's or pool's name. Derived names and labels must fit 63 characters, and the longest suffix has 15."""

NAME_PATTERN = r"^[a-z]([-a-z0-9]*[a-z0-9])?$"
"""Pattern of a name that is also valid for Services (RFC 1035 labels)."""


@dataclass(frozen=True)
class Column:
    """A column of ``kubectl get``."""

    name: str
    path: str
    description: str
    type: str = "string"
    wide: bool = False
    """Whether only ``-o wide`` shows the column."""


@dataclass(frozen=True)
class Kind:
    """One of Understudy's kinds."""

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


AGE = Column("Age", ".metadata.creationTimestamp", "Time since the object was created.", "date")

_SHORT_NAME = (
    (
        f"size(self.metadata.name) <= {LONGEST_NAME}",
        f"metadata.name is longer than {LONGEST_NAME} characters: the names of pods, NetworkPolicies and labels are "
        "derived from it and may have at most 63",
        ".metadata.name",
    ),
    (
        f"self.metadata.name.matches('{NAME_PATTERN}')",
        "metadata.name must begin with a letter and contain only lower-case letters, digits and dashes, because "
        "a Service is named after it",
        ".metadata.name",
    ),
)

_NOT_ITSELF = (
    "!has(self.spec.dependsOn) || self.spec.dependsOn.all(d, d.name != self.metadata.name)",
    "dependsOn contains this workload itself: name only other workloads",
    ".spec.dependsOn",
)

KINDS = (
    Kind(
        name="RobotWorkload",
        plural="robotworkloads",
        short="rw",
        description="One application of one robot: its pods, its ROS graph, its outputs to the robot, and the policy that "
        "protects it.",
        spec=RobotWorkloadSpec,
        status=RobotWorkloadStatus,
        columns=(
            Column("Active", ".status.active", "The pod that controls the robot."),
            Column("Health", ".status.health", "Unknown, Starting, Healthy, Degraded, Failed or Recovering."),
            Column(
                "Protected",
                '.status.conditions[?(@.type=="Protected")].status',
                "Whether the first strategy of the policy could run now; see the condition's message.",
            ),
            Column(
                "Standby",
                ".status.standby",
                "Readiness level of the standbys, and how many of them could take over now.",
            ),
            Column("Strategy", ".status.strategy", "The strategy that would be used if the workload failed now."),
            Column(
                "Recoveries",
                ".status.recoveryCount",
                "Number of recoveries and planned switchovers since the workload was created.",
                "integer",
            ),
            Column("Last", ".status.lastRecoveryTime", "Time since the last recovery.", "date"),
            Column("Order", ".status.strategies", "The strategies in order, with their pools.", wide=True),
            Column(
                "Situation",
                ".status.situation.name",
                "The situation that currently applies, as defined by the policy.",
                wide=True,
            ),
            Column("Gate", ".spec.gate.kind", "Kind of the gate.", wide=True),
            Column("Kept", ".status.kept", "Summary of the kept state of the healthy instance.", wide=True),
            Column(
                "Taken",
                ".status.state[0].takenAt",
                "Time since the first item in status.state was recorded.",
                "date",
                wide=True,
            ),
            AGE,
        ),
        rules=(*_SHORT_NAME, _NOT_ITSELF),
    ),
    Kind(
        name="FailurePolicy",
        plural="failurepolicies",
        short="fp",
        description="What healthy means for a RobotWorkload, and what to do, in which order, if it is not healthy.",
        spec=FailurePolicySpec,
        status=FailurePolicyStatus,
        columns=(
            Column(
                "Accepted",
                '.status.conditions[?(@.type=="Accepted")].status',
                "Whether the policy is valid; see the condition's message.",
            ),
            Column("Workloads", ".status.workloads", "Number of RobotWorkloads that use the policy.", "integer"),
            Column("Strategies", ".status.strategies", "Summary of the strategies, in order."),
            AGE,
        ),
    ),
    Kind(
        name="FallbackPool",
        plural="fallbackpools",
        short="fbp",
        description="A pool of instances that wait to take over (standbys): how many, how far they are prepared "
        "(readiness), and for which RobotWorkloads.",
        spec=FallbackPoolSpec,
        status=FallbackPoolStatus,
        columns=(
            Column("Readiness", ".spec.readiness", "How far the pool's instances are prepared."),
            Column("Desired", ".status.desired", "Number of waiting pods that should exist.", "integer"),
            Column("Ready", ".status.ready", "Number of waiting pods that could take over now.", "integer"),
            Column(
                "Claimed",
                ".status.claimed",
                "Number of this pool's pods that were claimed (taken for a workload) or have taken over.",
                "integer",
            ),
            Column(
                "Waiting",
                ".status.waiting",
                "Number of workloads that wait for a pod of this pool.",
                "integer",
                wide=True,
            ),
            Column(
                "Updated",
                ".status.updated",
                "Number of unclaimed pods with the current template.",
                "integer",
                wide=True,
            ),
            AGE,
        ),
        rules=_SHORT_NAME,
        scales=True,
    ),
)
