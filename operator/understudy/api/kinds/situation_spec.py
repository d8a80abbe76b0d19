"""Situations of a robot: how a policy defines them, and how the monitor reports the current one."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from understudy.api.base import Model, ReportedText, RosName, with_rules
from understudy.api.conditions import Time
from understudy.api.kinds.tree_spec import ShortForm, Text, Written

_ONE = "give exactly one of task, yaml (short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)"


class ActiveTask(Model):
    """A task with an active goal."""

    action: RosName
    """Fully qualified name of the action, such as /navigate_to_pose. It can be one of the workload's tasks or belong to
    another server."""


@with_rules(("[has(self.task), has(self.yaml), has(self.xml), has(self.osc)].filter(x, x).size() == 1", _ONE))
class When(Written):
    """Condition of a situation: an action has an active goal, or a tree succeeds."""

    task: ActiveTask | None = None
    """A task, which is a ROS action. The situation applies while the action has an active goal."""
    yaml: ShortForm | None = None
    """A tree in the short form (YAML), with the leaf nodes of health trees. The situation applies while the tree
    succeeds. See docs/trees.md."""
    xml: Text | None = None
    """The tree as a BehaviorTree.CPP 4 XML document."""
    osc: Text | None = None
    """The tree as OpenSCENARIO 2 text that imports osc.understudy."""

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.languages + (self.task is not None) != 1:
            raise ValueError(_ONE)
        return self


class SituationStatus(Model):
    """The current situation of the robot."""

    name: str
    """Name of one of the policy's spec.situations."""
    since: Time
    """When the situation began."""
    reason: ReportedText = ""
    """Why the situation applies."""
