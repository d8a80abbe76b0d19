"""Situations of a robot: how a policy defines them, and how the monitor reports the current one."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from understudy.api.base import Model, RosName, rules
from understudy.api.conditions import Time
from understudy.api.kinds.tree_spec import Written, short_form, text

_ONE = "give exactly one of task, yaml (short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


class ActiveTask(Model):
    """A task with an active goal."""

    action: RosName = Field(
        description="Fully qualified name of the action, such as /navigate_to_pose. It can be one of the workload's tasks "
        "or belong to another server."
    )


class When(Written):
    """Condition of a situation: an action has an active goal, or a tree succeeds."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            ("[has(self.task), has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1", _ONE),
        )
    }

    task: ActiveTask | None = Field(
        default=None, description="The situation applies while this action has an active goal."
    )
    yaml: dict[str, Any] | None = short_form(
        "The situation applies while this tree succeeds, in the short form with the leaves of health trees. See "
        "docs/trees.md."
    )
    xml: str | None = text("The tree as a BehaviorTree.CPP 4 XML document.")
    osc: str | None = text("The tree as OpenSCENARIO 2 text that imports osc.understudy.")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.given + (self.task is not None) != 1:
            raise ValueError(_ONE)
        return self


class SituationStatus(Model):
    """The current situation of the robot."""

    name: str = Field(description="Name of one of the policy's spec.situations.")
    since: Time = Field(description="When the situation began.")
    reason: str = Field(default="", description="Why the situation applies.")
