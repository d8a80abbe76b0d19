"""Trees in the API: in the short form, as BehaviorTree.CPP 4 XML, or as OpenSCENARIO 2, each in its own field."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from understudy.api.base import LONGEST_TEXT, Model

Form = Literal["yaml", "xml", "osc"]
"""The language of a tree, as the name of the field that holds it."""


def short_form(description: str) -> Any:
    """Return the field of a tree in the short form."""
    return Field(
        default=None,
        min_length=1,
        description=description,
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )


def text(description: str) -> Any:
    """Return the field of a tree that is a text."""
    return Field(default=None, min_length=1, max_length=LONGEST_TEXT, description=description)


class Written(Model):
    """Base of models that hold a tree in one of the three languages. Subclasses describe the fields and require exactly one."""

    yaml: dict[str, Any] | None = None
    xml: str | None = None
    osc: str | None = None

    @property
    def given(self) -> int:
        """Number of languages in which a tree is given."""
        return sum(one is not None for one in (self.yaml, self.xml, self.osc))

    @property
    def form(self) -> Form:
        """The language of the tree: the name of the field that holds it."""
        if self.yaml is not None:
            return "yaml"
        return "xml" if self.xml is not None else "osc"

    @property
    def tree(self) -> dict[str, Any] | str:
        """The tree, in the form in which it was given."""
        tree = next((one for one in (self.yaml, self.xml, self.osc) if one is not None), None)
        assert tree is not None, "a tree is given"
        return tree
