"""A procedure: a behaviour tree that the agent runs once on an instance, from inside its pod, to bring it to a certain state."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from understudy.api.base import Duration, with_rules
from understudy.api.kinds.tree_spec import ShortForm, Text, Written


@with_rules(
    (
        "has(self.yaml) || has(self.xml) || has(self.osc)",
        "a tree is required: give exactly one of yaml (short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)",
        ".yaml",
    ),
    (
        "!has(self.yaml) || !has(self.xml)",
        "the tree is already given as yaml: give exactly one of yaml, xml and osc",
        ".xml",
    ),
    (
        "!has(self.osc) || !has(self.yaml) && !has(self.xml)",
        "the tree is already given as yaml or xml: give exactly one of yaml, xml and osc",
        ".osc",
    ),
)
class _Tree(Written):
    """A tree in one of the three languages."""

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.languages != 1:
            raise ValueError("give exactly one of yaml, xml and osc")
        return self


class Procedure(_Tree):
    """Steps to run on one instance, and the time they may take. Steps whose result already exists do nothing."""

    yaml: ShortForm | None = None
    """The tree in the short form (YAML). The value is the root node, such as sequence, set_lifecycle or call_service.
    See docs/procedures.md."""
    xml: Text | None = None
    """The tree as a BehaviorTree.CPP 4 XML document, as Groot 2 writes it. See docs/procedures.md."""
    osc: Text | None = None
    """The tree as OpenSCENARIO 2 text that imports osc.understudy. See docs/procedures.md."""
    within: Duration = "60s"
    """Maximum duration. A procedure that takes longer fails. In a recovery, the next strategy is then tried. On a
    standby or the first instance, the monitor runs the procedure again after a delay, which doubles each time from 5 s
    to 1 min, and the condition BroughtUp of the RobotWorkload reports the failure."""


class Check(_Tree):
    """A condition of one instance, evaluated repeatedly from inside its pod."""

    yaml: ShortForm | None = None
    """The tree in the short form (YAML), with condition nodes only, such as lifecycle_is or topic. See
    docs/procedures.md."""
    xml: Text | None = None
    """The tree as a BehaviorTree.CPP 4 XML document, with condition nodes only. See docs/procedures.md."""
    osc: Text | None = None
    """The tree as OpenSCENARIO 2 text, with condition nodes only. See docs/procedures.md."""
    period: Duration = "1s"
    """Time between two evaluations."""
