"""Planned switchovers: how one is asked for, and how it is told what becomes of it.

A request is an annotation, ``failover`` or ``failback`` and the moment in which it was written. The moment makes it unlike every other
one, so it is carried out once and no more, and tells one that nobody took up in time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import Field

from understudy.api.base import Duration, Model
from understudy.api.conditions import Time

Verb = Literal["failover", "failback"]
Kind = Literal["Failover", "Failback", "Drain"]
Phase = Literal["Waiting", "Preparing", "Switching", "Done", "NotDone"]

ENDED: tuple[Phase, ...] = ("Done", "NotDone")
"""The phases in which nothing more comes of a switchover."""

_KINDS: dict[str, Kind] = {"failover": "Failover", "failback": "Failback"}
_WRITTEN = re.compile(r"(\S+)\s+(\S+)")


@dataclass(frozen=True)
class Request:
    """A switchover that was asked for."""

    text: str
    """As it stands in the annotation, which is what tells it from every other one."""
    kind: Kind
    at: float
    """When it was, in unix seconds, by the clock of whoever asked."""


def request(verb: Verb, now: float) -> str:
    """The annotation by which a switchover is asked for now (unix seconds)."""
    return f"{verb} {datetime.fromtimestamp(now, UTC).isoformat(timespec='microseconds').replace('+00:00', 'Z')}"


def parse(text: str) -> Request:
    """What an annotation asks for. Raises ValueError, which says what would be right."""
    found = _WRITTEN.fullmatch(text.strip())
    try:
        if found is None or found[1] not in _KINDS:
            raise ValueError
        at = datetime.fromisoformat(found[2].replace("Z", "+00:00").replace(",", "."))
    except ValueError:
        raise ValueError(
            f"{text!r} asks for nothing that is known: write failover or failback and the present time, such as "
            f'"{request("failover", 1.8e9)}"'
        ) from None
    return Request(text, _KINDS[found[1]], (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp())


class SwitchoverStatus(Model):
    """The last planned switchover, or the one that is under way."""

    kind: Kind = Field(description="Failover or Failback: somebody asked for it. Drain: its node is to be emptied.")
    request: str = Field(default="", description="The annotation that asked for it; empty where none did.")
    handled: str = Field(
        default="", description="The last such annotation that came to its end. It is not carried out again."
    )
    phase: Phase = Field(
        description="Waiting: it can't begin yet. Preparing: the understudy is brought to where it can drive. Switching: the gate names "
        "it, and it is awaited at the robot. Done, or NotDone: the robot is driven by the one that drove it before."
    )
    message: str = Field(default="", description="Why it waits or came to nothing, and what came of it.")
    target: str = Field(default="", description="The understudy.")
    recovery: str = Field(default="", description="Id of its record in recoveries, once the gate was switched.")
    since: Time = Field(description="Since when it is in this phase.")


class Draining(Model):
    """What becomes of the instance in control while its node is being drained."""

    hold_for: Duration = Field(
        default="5m",
        description="How long evictions of the instance in control wait for an understudy on another node to take over, from when the "
        "operator saw the node cordoned; 0s: they don't. See docs/switchover.md.",
    )


class Drain(Model):
    """What the operator tells a monitor whose instance in control runs on a node that is to be emptied."""

    uid: str = Field(description="UID of that instance.")
    node: str = Field(description="The node.")
    since: float = Field(description="When the operator saw that, in unix seconds.")
    cordoned: list[str] = Field(description="All nodes that are to be emptied: an understudy on them would be next.")
