"""Degraded: healthy, so that nothing is failed over, and yet not well. What that means, and what is done about it."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from understudy.api.base import Duration, LocalReference, Model, matching, rules
from understudy.api.kinds.tree_spec import Written, short_form, text

_ONE_TREE = "give exactly one of yaml (the short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


class InlineTree(Written):
    """A tree of the leaves of health trees, in one of their languages."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            ("[has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1", f"one tree: {_ONE_TREE}"),
        )
    }

    yaml: dict[str, Any] | None = short_form(
        "The tree in the short form: one node, such as parallel or topic. See docs/trees.md."
    )
    xml: str | None = text("The tree instead as the text of a BehaviorTree.CPP 4 file.")
    osc: str | None = text("The tree instead as the text of an OpenSCENARIO 2 file that imports osc.understudy.")

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.given != 1:
            raise ValueError(f"one tree: {_ONE_TREE}")
        return self


class WellTree(InlineTree):
    """What well means, and how long it must not be so before that counts."""

    debounce: Duration = Field(
        default="2s", description="The tree must fail for this long before the workload is degraded."
    )


CPU_PATTERN = r"^([1-9][0-9]*m|[1-9][0-9]*(\.[0-9]{1,3})?|0\.[0-9]{0,2}[1-9])$"
CPU_MESSAGE = "write cores as a text, such as 500m, 1.5 or 2"

Cpu = Annotated[str, Field(pattern=CPU_PATTERN, max_length=16, json_schema_extra=matching(CPU_PATTERN, CPU_MESSAGE))]
"""An amount of CPU, to a thousandth of a core."""

MEMORY_PATTERN = r"^[1-9][0-9]*(Ki|Mi|Gi|Ti|k|M|G|T)$"
MEMORY_MESSAGE = "write bytes as a whole number with a suffix, such as 256Mi or 1Gi"

Memory = Annotated[
    str, Field(pattern=MEMORY_PATTERN, max_length=16, json_schema_extra=matching(MEMORY_PATTERN, MEMORY_MESSAGE))
]
"""An amount of memory."""


class Resize(Model):
    """More CPU or memory for the pod in control, in place (KEP-1287): its processes go on."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            ("has(self.cpu) || has(self.memory)", "say how much it gets: give cpu, memory or both"),
        )
    }

    container: str | None = Field(
        default=None,
        min_length=1,
        max_length=63,
        description="The container that gets more. Absent: the first one of the pod.",
    )
    cpu: Cpu | None = Field(
        default=None,
        description="CPU that it has then, such as 1500m: its request, and its limit where it has one. Never less than before.",
    )
    memory: Memory | None = Field(
        default=None,
        description="Memory that it has then, such as 1Gi: its request, and its limit where it has one. Never less than before.",
    )

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.cpu is None and self.memory is None:
            raise ValueError("say how much it gets: give cpu, memory or both")
        return self

    @property
    def amounts(self) -> dict[str, str]:
        """What it gets, by resource."""
        return {name: found for name, found in (("cpu", self.cpu), ("memory", self.memory)) if found is not None}


class Reschedule(Model):
    """A planned hand-over to another instance, begun by the monitor at a moment in which the robot has nothing to do."""

    after: Duration = Field(default="30s", description="It must have been degraded for so long.")
    idle_for: Duration = Field(
        default="5s", description="Nothing must have been worked on for so long, without a break."
    )
    idle: InlineTree | None = Field(
        default=None,
        description="What else must hold for the robot to count as idle, beside that no goal of the workload's tasks is active. "
        "Required where the workload has no tasks.",
    )
    pause: Duration = Field(
        default="10m",
        description="Least time between two planned hand-overs: where the next instance is degraded too, it isn't the instance.",
    )


class Prewarm(Model):
    """One standby more for this workload, of a pool that a strategy names."""

    pool_ref: LocalReference = Field(
        description="The FallbackPool, Initialized or Executing. With perWorkload 0 it has no standby of this workload otherwise."
    )


class Action(Model):
    """One thing that is done while the workload is degraded."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "[has(self.resize), has(self.prewarm), has(self.reschedule)].filter(x, x).size() == 1",
                "an action is exactly one of resize, prewarm and reschedule: begin a list item for each",
            ),
        )
    }

    resize: Resize | None = Field(
        default=None,
        description="Give the pod in control more CPU or memory, in place. Needs Kubernetes 1.33 or newer.",
    )
    prewarm: Prewarm | None = Field(
        default=None, description="Keep one standby more of a pool ready for it, so that a failure would be met faster."
    )
    reschedule: Reschedule | None = Field(
        default=None,
        description="Hand over to another instance by the policy's strategies, at the next idle moment.",
    )


class Degraded(Model):
    """What a healthy workload lacks to be well, and what is done about it while nothing is failed over."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "!has(self.actions) || self.actions.filter(a, has(a.reschedule)).size() <= 1",
                "reschedule is given twice: one says when",
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
        description="What well means: usually the health tree's topics with tighter bounds. A workload is Degraded while this tree "
        "fails and the health tree holds."
    )
    clear_after: Duration = Field(
        default="10s",
        description="The tree must hold for this long, without a break, before the workload is Healthy again.",
    )
    actions: list[Action] = Field(
        default_factory=list, max_length=8, description="What is done while it is degraded. None: it is only told."
    )

    @property
    def reschedule(self) -> Reschedule | None:
        """When it is handed over; None for never."""
        return next((one.reschedule for one in self.actions if one.reschedule is not None), None)
