"""Trees in the API: in the short form, as BehaviorTree.CPP 4 XML, or as OpenSCENARIO 2, each in its own field."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from understudy.api.base import BOUNDED, LONGEST_TEXT, Model

Form = Literal["yaml", "xml", "osc"]
"""The language of a tree, as the name of the field that holds it."""


ShortForm = Annotated[dict[str, Any], Field(min_length=1), BOUNDED]
"""A tree in the short form."""

Text = Annotated[str, Field(min_length=1, max_length=LONGEST_TEXT)]
"""A tree that is a text."""


class Written(Model):
    """Base of models that hold a tree in one of the three languages. Subclasses describe the fields and require exactly one."""

    yaml: ShortForm | None = None
    xml: Text | None = None
    osc: Text | None = None

    @property
    def languages(self) -> int:
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
