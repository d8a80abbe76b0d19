"""Degraded: the health tree succeeds, so no failover is needed, but a stricter tree fails. Defines that tree and the response."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from understudy.api.base import Duration, LocalReference, Model, matching, with_rules
from understudy.api.kinds.tree_spec import ShortForm, Text, Written

_ONE_TREE = "give exactly one of yaml (short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


@with_rules(
    ("[has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1", f"a tree is required: {_ONE_TREE}"),
)
class InlineTree(Written):
    """A tree with the leaves of health trees, in one of the three languages."""

    yaml: ShortForm | None = None
    """The tree in the short form (YAML). The value is the root node, such as parallel or topic. See docs/trees.md."""
    xml: Text | None = None
    """The tree as a BehaviorTree.CPP 4 XML document."""
    osc: Text | None = None
    """The tree as OpenSCENARIO 2 text that imports osc.understudy."""

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.languages != 1:
            raise ValueError(f"a tree is required: {_ONE_TREE}")
        return self


class WellTree(InlineTree):
    """A stricter tree than the health tree, and how long it must fail for the workload to count as degraded."""

    debounce: Duration = "2s"
    """How long the tree must fail without interruption before the workload counts as degraded."""


CPU_PATTERN = r"^([1-9][0-9]*m|[1-9][0-9]*(\.[0-9]{1,3})?|0\.[0-9]{0,2}[1-9])$"
CPU_MESSAGE = "write the number of cores as a string, such as 500m, 1.5 or 2"

Cpu = Annotated[str, matching(CPU_PATTERN, CPU_MESSAGE, max_length=16)]
"""An amount of CPU, with a precision of one thousandth of a core."""

MEMORY_PATTERN = r"^[1-9][0-9]*(Ki|Mi|Gi|Ti|k|M|G|T)$"
MEMORY_MESSAGE = "write bytes as a whole number with a suffix, such as 256Mi or 1Gi"

Memory = Annotated[str, matching(MEMORY_PATTERN, MEMORY_MESSAGE, max_length=16)]
"""An amount of memory."""


@with_rules(("has(self.cpu) || has(self.memory)", "give the new amount: cpu, memory or both"))
class Resize(Model):
    """Increases CPU or memory of the active pod in place (KEP-1287), without a restart of its processes."""

    container: str | None = Field(default=None, min_length=1, max_length=63)
    """Name of the container to resize. Absent: the first container of the pod."""
    cpu: Cpu | None = None
    """CPU while the workload is degraded, such as 1500m. Understudy sets the request and, if the container has a limit,
    the limit. It never reduces either."""
    memory: Memory | None = None
    """Memory while the workload is degraded, such as 1Gi. Understudy sets the request and, if the container has a
    limit, the limit. It never reduces either."""

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.cpu is None and self.memory is None:
            raise ValueError("give the new amount: cpu, memory or both")
        return self

    @property
    def amounts(self) -> dict[str, str]:
        """The amounts, by resource name."""
        return {name: found for name, found in (("cpu", self.cpu), ("memory", self.memory)) if found is not None}


class Reschedule(Model):
    """A planned switchover to another instance at a moment when the robot is idle."""

    after: Duration = "30s"
    """How long the workload must be degraded before the switchover."""
    idle_for: Duration = "5s"
    """How long the robot must be idle without interruption before the switchover."""
    idle: InlineTree | None = None
    """Additional condition for the robot to count as idle. Without it, the robot is idle if the workload's tasks have
    no active goal. Required if the workload has no tasks."""
    pause: Duration = "10m"
    """Minimum interval between two planned switchovers of a degraded instance. It prevents a series of them if the
    cause is not the instance."""


class Prewarm(Model):
    """Adds one standby for this workload to a pool that a strategy names."""

    pool_ref: LocalReference
    """A FallbackPool with readiness Initialized or Executing. If the pool's perWorkload is 0, it has a standby for this
    workload only while the workload is degraded."""


@with_rules(
    (
        "[has(self.resize), has(self.prewarm), has(self.reschedule)].filter(x, x).size() == 1",
        "each action has exactly one of resize, prewarm and reschedule: use a separate list item for each",
    ),
)
class Action(Model):
    """One action while the workload is degraded."""

    resize: Resize | None = None
    """Give the active pod more CPU or memory, in place. Requires Kubernetes 1.33 or newer."""
    prewarm: Prewarm | None = None
    """Keep one more standby in a pool while the workload is degraded, so that a recovery would take less time."""
    reschedule: Reschedule | None = None
    """Planned switchover: when the robot is idle, the monitor replaces the active instance with the policy's
    strategies, as after a failure."""


@with_rules(
    (
        "!has(self.actions) || self.actions.filter(a, has(a.reschedule)).size() <= 1",
        "actions contains reschedule twice",
        ".actions",
    ),
    (
        "!has(self.actions) || self.actions.all(a, !has(a.prewarm) || self.actions.exists_one(b, has(b.prewarm) && "
        "b.prewarm.poolRef.name == a.prewarm.poolRef.name))",
        "prewarm names the same pool twice",
        ".actions",
    ),
)
class Degraded(Model):
    """When a healthy workload counts as degraded, and what to do then."""

    monitoring: WellTree
    """A stricter tree, usually with the topics of the health tree and tighter bounds. The workload is Degraded while
    this tree fails and the health tree succeeds."""
    clear_after: Duration = "10s"
    """How long the tree must succeed without interruption before the workload is Healthy again."""
    actions: list[Action] = Field(default_factory=list, max_length=8)
    """What to do while the workload is degraded. Empty: it is only reported."""

    @property
    def reschedule(self) -> Reschedule | None:
        """The settings of the planned switchover, or None if there is none."""
        return next((one.reschedule for one in self.actions if one.reschedule is not None), None)
