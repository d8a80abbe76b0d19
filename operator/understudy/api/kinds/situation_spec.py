"""Situations of a robot: when each of them is, as a policy says it, and which one is in force, as the monitor says it."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from understudy.api.base import Model, RosName, rules
from understudy.api.conditions import Time
from understudy.api.kinds.tree_spec import Written, short_form, text

_ONE = "say when it is by exactly one of task, yaml (the short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


class ActiveTask(Model):
    """A task that is being worked on."""

    action: RosName = Field(
        description="The action, fully qualified, such as /navigate_to_pose: one of the workload's tasks, or of another server."
    )


class When(Written):
    """When a robot is in a situation: while a goal of an action is active, or while a tree holds."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            ("[has(self.task), has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1", _ONE),
        )
    }

    task: ActiveTask | None = Field(default=None, description="While a goal of this action is active.")
    yaml: dict[str, Any] | None = short_form(
        "Instead, while this tree holds, of the leaves of health trees in the short form. See docs/trees.md."
    )
    xml: str | None = text("Instead, the tree as the text of a BehaviorTree.CPP 4 file.")
    osc: str | None = text("Instead, the tree as the text of an OpenSCENARIO 2 file that imports osc.understudy.")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.given + (self.task is not None) != 1:
            raise ValueError(_ONE)
        return self


class SituationStatus(Model):
    """The situation that the robot is in."""

    name: str = Field(description="One of spec.situations of the policy.")
    since: Time = Field(description="Since when.")
    reason: str = Field(default="", description="By what it is known.")
