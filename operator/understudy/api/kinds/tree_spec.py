"""Trees as they are written: in the short form, or as a text of BehaviorTree.CPP 4 or OpenSCENARIO 2, each in a field of its own."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from understudy.api.base import LONGEST_TEXT, Model

Form = Literal["yaml", "xml", "osc"]
"""What a tree is written in: the field that it stands in."""


def short_form(description: str) -> Any:
    """The field of a tree in the short form."""
    return Field(
        default=None,
        min_length=1,
        description=description,
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )


def text(description: str) -> Any:
    """The field of a tree that is a text."""
    return Field(default=None, min_length=1, max_length=LONGEST_TEXT, description=description)


class Written(Model):
    """What has a tree in one of the three languages; which trees, its fields say, and by its rules that there is one."""

    yaml: dict[str, Any] | None = None
    xml: str | None = None
    osc: str | None = None

    @property
    def given(self) -> int:
        """In how many languages there is one."""
        return sum(one is not None for one in (self.yaml, self.xml, self.osc))

    @property
    def form(self) -> Form:
        """What the tree is written in: the field that it stands in."""
        if self.yaml is not None:
            return "yaml"
        return "xml" if self.xml is not None else "osc"

    @property
    def tree(self) -> dict[str, Any] | str:
        """The tree as it was written."""
        tree = next((one for one in (self.yaml, self.xml, self.osc) if one is not None), None)
        assert tree is not None, "one of them is given"
        return tree
