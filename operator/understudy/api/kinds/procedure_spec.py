"""A procedure: a behaviour tree that is run once on an instance, from inside its pod, to bring it somewhere."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from understudy.api.base import Duration, rules
from understudy.api.kinds.tree_spec import Written, short_form, text


class _Tree(Written):
    """A tree in one of the three languages."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            (
                "has(self.yaml) || has(self.xml) || has(self.osc)",
                "a tree is required: give exactly one of yaml (the short form), xml (BehaviorTree.CPP 4) and osc (OpenSCENARIO 2)",
                ".yaml",
            ),
            (
                "!has(self.yaml) || !has(self.xml)",
                "the tree is given as yaml already: give exactly one of yaml, xml and osc",
                ".xml",
            ),
            (
                "!has(self.osc) || !has(self.yaml) && !has(self.xml)",
                "the tree is given as yaml or xml already: give exactly one of yaml, xml and osc",
                ".osc",
            ),
        )
    }

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.given != 1:
            raise ValueError("give exactly one of yaml, xml and osc")
        return self


class Procedure(_Tree):
    """What is done to one instance, and the time that it has. It can be repeated: what is so already is left alone."""

    yaml: dict[str, Any] | None = short_form(
        "The tree in the short form: one node, such as sequence, set_lifecycle or call_service. See docs/procedures.md."
    )
    xml: str | None = text(
        "The tree instead as the text of a BehaviorTree.CPP 4 file, as Groot 2 writes it. See docs/procedures.md."
    )
    osc: str | None = text(
        "The tree instead as the text of an OpenSCENARIO 2 file that imports osc.understudy. See docs/procedures.md."
    )
    within: Duration = Field(default="60s", description="It fails when it isn't done in this time.")


class Check(_Tree):
    """What must hold of one instance, looked at again and again from inside its pod."""

    yaml: dict[str, Any] | None = short_form(
        "The tree in the short form, of conditions only, such as lifecycle_is or topic. See docs/procedures.md."
    )
    xml: str | None = text(
        "The tree instead as the text of a BehaviorTree.CPP 4 file, of conditions only. See docs/procedures.md."
    )
    osc: str | None = text(
        "The tree instead as the text of an OpenSCENARIO 2 file, of conditions only. See docs/procedures.md."
    )
    period: Duration = Field(default="1s", description="Time between two looks.")
