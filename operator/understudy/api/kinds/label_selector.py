"""Label selectors, as elsewhere in Kubernetes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from understudy.api.base import Model, with_rules


@with_rules(
    (
        "self.operator in ['In', 'NotIn'] ? has(self.values) && size(self.values) > 0 "
        ": !has(self.values) || size(self.values) == 0",
        "values are required for the operators In and NotIn, and not allowed for others",
        ".values",
    ),
)
class LabelSelectorRequirement(Model):
    """One expression of a label selector."""

    key: str = Field(min_length=1, max_length=317)
    """Label key."""
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"]
    """In, NotIn, Exists or DoesNotExist."""
    values: list[Annotated[str, Field(max_length=63)]] | None = Field(default=None, max_length=64)
    """Values. Only for the operators In and NotIn."""


class LabelSelector(Model):
    """A label selector, as elsewhere in Kubernetes. An empty selector selects everything."""

    match_labels: dict[str, str] | None = Field(default=None, max_length=64)
    """Labels that must all be present."""
    match_expressions: list[LabelSelectorRequirement] | None = Field(default=None, max_length=16)
    """Expressions that must all be true."""
