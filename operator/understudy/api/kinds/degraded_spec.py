"""Degraded: the health tree succeeds, so no failover is needed, but a stricter tree fails. Defines that tree and the response."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from understudy.api.base import Duration, LocalReference, Model, matching, rules
from understudy.api.kinds.tree_spec import Written, short_form, text

_ONE_TREE = "give exactly one of yaml (short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


class InlineTree(Written):
    """A tree with the leaves of health trees, in one of the three languages."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            (
                "[has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1",
                f"a tree is required: {_ONE_TREE}",
            ),
        )
    }

    yaml: dict[str, Any] | None = short_form(
        "The tree in the short form: one node, such as parallel or topic. See docs/trees.md."
    )
    xml: str | None = text("The tree as a BehaviorTree.CPP 4 XML document.")
    osc: str | None = text("The tree as OpenSCENARIO 2 text that imports osc.understudy.")

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.given != 1:
            raise ValueError(f"a tree is required: {_ONE_TREE}")
        return self


class WellTree(InlineTree):
    """A stricter tree than the health tree, and how long it must fail for the workload to count as degraded."""

    debounce: Duration = Field(
        default="2s",
        description="How long the tree must fail without interruption before the workload counts as degraded.",
    )


CPU_PATTERN = r"^([1-9][0-9]*m|[1-9][0-9]*(\.[0-9]{1,3})?|0\.[0-9]{0,2}[1-9])$"
CPU_MESSAGE = "write cores as a text, such as 500m, 1.5 or 2"

Cpu = Annotated[str, Field(pattern=CPU_PATTERN, max_length=16, json_schema_extra=matching(CPU_PATTERN, CPU_MESSAGE))]
"""An amount of CPU, with a precision of one thousandth of a core."""

MEMORY_PATTERN = r"^[1-9][0-9]*(Ki|Mi|Gi|Ti|k|M|G|T)$"
MEMORY_MESSAGE = "write bytes as a whole number with a suffix, such as 256Mi or 1Gi"

Memory = Annotated[
    str, Field(pattern=MEMORY_PATTERN, max_length=16, json_schema_extra=matching(MEMORY_PATTERN, MEMORY_MESSAGE))
]
"""An amount of memory."""


class Resize(Model):
    """Increases CPU or memory of the active pod in place (KEP-1287), without a restart of its processes."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            ("has(self.cpu) || has(self.memory)", "give the new amount: cpu, memory or both"),
        )
    }

    container: str | None = Field(
        default=None,
        min_length=1,
        max_length=63,
        description="Name of the container to resize. Absent: the first container of the pod.",
    )
    cpu: Cpu | None = Field(
        default=None,
        description="CPU while the workload is degraded, such as 1500m. It sets the request and, if the container has one, "
        "the limit. It never reduces them.",
    )
    memory: Memory | None = Field(
        default=None,
        description="Memory while the workload is degraded, such as 1Gi. It sets the request and, if the container has one, "
        "the limit. It never reduces them.",
    )

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
    """A planned hand-over to another instance at a moment when the robot is idle."""

    after: Duration = Field(default="30s", description="How long the workload must have been degraded.")
    idle_for: Duration = Field(default="5s", description="How long the robot must have been idle without interruption.")
    idle: InlineTree | None = Field(
        default=None,
        description="Additional condition for the robot to count as idle. Without it, the robot is idle if the workload's "
        "tasks have no active goal. Required if the workload has no tasks.",
    )
    pause: Duration = Field(
        default="10m",
        description="Minimum time between two planned hand-overs. If the next instance is degraded too, the instance is "
        "probably not the cause.",
    )


class Prewarm(Model):
    """Adds one standby for this workload to a pool that a strategy names."""

    pool_ref: LocalReference = Field(
        description="The FallbackPool (Initialized or Executing). With perWorkload 0, the pool has a standby for this "
        "workload only while it is degraded."
    )


class Action(Model):
    """One action while the workload is degraded."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "[has(self.resize), has(self.prewarm), has(self.reschedule)].filter(x, x).size() == 1",
                "each action has exactly one of resize, prewarm and reschedule: use a separate list item for each",
            ),
        )
    }

    resize: Resize | None = Field(
        default=None,
        description="Give the active pod more CPU or memory, in place. Requires Kubernetes 1.33 or newer.",
    )
    prewarm: Prewarm | None = Field(
        default=None,
        description="Keep one more standby ready in a pool, so that a failure would be recovered from faster.",
    )
    reschedule: Reschedule | None = Field(
        default=None,
        description="Hand over to another instance with the policy's strategies, when the robot is next idle.",
    )


class Degraded(Model):
    """When a healthy workload counts as degraded, and what to do then."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
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
    }

    monitoring: WellTree = Field(
        description="A stricter tree, usually with the topics of the health tree and tighter bounds. The workload is "
        "Degraded while this tree fails and the health tree succeeds."
    )
    clear_after: Duration = Field(
        default="10s",
        description="How long the tree must succeed without interruption before the workload is Healthy again.",
    )
    actions: list[Action] = Field(
        default_factory=list,
        max_length=8,
        description="What to do while the workload is degraded. Empty: it is only reported.",
    )

    @property
    def reschedule(self) -> Reschedule | None:
        """The settings of the planned hand-over, or None if there is none."""
        return next((one.reschedule for one in self.actions if one.reschedule is not None), None)
