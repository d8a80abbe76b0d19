"""Status conditions by the Kubernetes API conventions (type, status, reason, message, times)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from understudy.api.base import Model
from understudy.api.plain_text import one_line

MESSAGE_MOST = 32768
"""Longest message of a condition, in characters."""

READY = "Ready"
"""The condition that tools for all kinds wait for."""

Status = Literal["True", "False", "Unknown"]

Time = Annotated[str, Field(json_schema_extra={"format": "date-time"})]
"""A time in RFC 3339, with any number of digits for the fraction of a second."""


class Condition(Model):
    """One aspect of an object's state, as ``kubectl describe`` and ``kubectl wait`` read it."""

    type: str = Field(max_length=316)
    """Type of the condition, as listed in the description of conditions."""
    status: Status
    """True, False or Unknown."""
    reason: str = Field(min_length=1, max_length=1024, pattern=r"^[A-Za-z]([A-Za-z0-9_,:]*[A-Za-z0-9_])?$")
    """Reason for the status, in one CamelCase word."""
    message: str = Field(default="", max_length=MESSAGE_MOST)
    """What was found and, if something is wrong, how to correct it."""
    last_transition_time: Time
    """When the status last changed, RFC 3339."""
    observed_generation: int | None = Field(default=None, ge=0)
    """Generation of the spec that the condition refers to."""


Conditions = Annotated[
    list[Condition],
    Field(json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]}),
]
"""The conditions of an object, one of each type."""


def now() -> str:
    """Return the current time in RFC 3339 with seconds, as Kubernetes writes it."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def condition(
    type_: str, status: Status | bool, reason: str, message: str, *, generation: int | None = None
) -> Condition:
    """Return a condition that begins now. :func:`merged` keeps an older transition time if the status did not change.

    A message may quote others, such as the log of a robot's node, so control characters in it are escaped. One that is too
    long, such as the API server's errors for every field of a template, is cut at the end.
    """
    text: Status = status if isinstance(status, str) else ("True" if status else "False")
    return Condition(
        type=type_,
        status=text,
        reason=reason,
        message=one_line(message, MESSAGE_MOST),
        last_transition_time=now(),
        observed_generation=generation,
    )


def summary(conditions: Iterable[Condition], types: Sequence[str]) -> Condition:
    """Return the condition Ready, which kstatus reads: it repeats the first of these types that is not True, or the last."""
    found = {one.type: one for one in conditions}
    shown = next((found[type_] for type_ in types if found[type_].status != "True"), found[types[-1]])
    return shown.model_copy(update={"type": READY, "status": "True" if shown.status == "True" else "False"})


def is_summary(one: Mapping[str, Any], conditions: Iterable[Mapping[str, Any]]) -> bool:
    """Whether a condition (as in the API) is Ready and repeats another one, which is reported by itself."""
    others = ((other["reason"], other.get("message")) for other in conditions if other["type"] != READY)
    return one["type"] == READY and (one["reason"], one.get("message")) in others


def merged(old: Iterable[Condition], new: Iterable[Condition]) -> list[Condition]:
    """Return the new conditions. Each keeps the old transition time unless its status changed."""
    before = {c.type: c for c in old}
    return [
        c.model_copy(update={"last_transition_time": before[c.type].last_transition_time})
        if c.type in before and before[c.type].status == c.status
        else c
        for c in new
    ]
