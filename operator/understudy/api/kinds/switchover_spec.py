"""Planned switchovers: how a user requests one, and how its progress is reported.

A request is an annotation that contains ``failover`` or ``failback`` and the time at which it was written. The time makes every
request unique, so that it is carried out only once, and it reveals requests that nobody handled in time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from understudy.api.base import Duration, Model, ReportedText
from understudy.api.conditions import Time

Verb = Literal["failover", "failback"]
Kind = Literal["Failover", "Failback", "Drain"]
Phase = Literal["Waiting", "Preparing", "Switching", "Done", "NotDone"]

ENDED: tuple[Phase, ...] = ("Done", "NotDone")
"""The final phases of a switchover."""

_KINDS: dict[str, Kind] = {"failover": "Failover", "failback": "Failback"}
_WRITTEN = re.compile(r"(\S+)\s+(\S+)")


@dataclass(frozen=True)
class Request:
    """A request for a switchover."""

    text: str
    """The text of the annotation, which identifies the request."""
    kind: Kind
    at: float
    """When the request was made, in unix seconds, by the clock of the user who made it."""


def request(verb: Verb, now: float) -> str:
    """Return the annotation that requests a switchover now (unix seconds)."""
    return f"{verb} {datetime.fromtimestamp(now, UTC).isoformat(timespec='microseconds').replace('+00:00', 'Z')}"


def parse(text: str) -> Request:
    """Return the request in an annotation. Raises ValueError, whose message says what is expected."""
    found = _WRITTEN.fullmatch(text.strip())
    try:
        if found is None or found[1] not in _KINDS:
            raise ValueError
        at = datetime.fromisoformat(found[2].replace("Z", "+00:00").replace(",", "."))
    except ValueError:
        raise ValueError(
            f"{text!r} is not a known request: write failover or failback and the current time, such as "
            f'"{request("failover", 1.8e9)}"'
        ) from None
    return Request(text, _KINDS[found[1]], (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp())


class SwitchoverStatus(Model):
    """The last planned switchover (change of the active instance without a failure), or the one in progress."""

    kind: Kind
    """Failover or Failback: a user requested it. Drain: the node of the active instance is being drained."""
    request: str = ""
    """The annotation that requested the switchover. Empty for Drain."""
    handled: str = ""
    """Annotation of the last request that has ended. The monitor does not carry out this request again."""
    phase: Phase
    """Waiting: the switchover cannot begin yet. Preparing: the understudy (the instance that takes over) is being
    prepared, or is prepared and waits for the reason in the message. Switching: the gate is open for the understudy,
    and its outputs are not yet verified at the robot. Done: the understudy controls the robot. NotDone: the switchover
    was given up, and the previous instance still controls the robot."""
    message: ReportedText = ""
    """Why the switchover waits or did not happen, or its result."""
    target: str = ""
    """Name of the understudy's pod."""
    recovery: str = ""
    """Id of the switchover's record in recoveries. Empty until the gate has switched."""
    since: Time
    """When this phase began."""


class Draining(Model):
    """What happens to the active instance while its node is drained."""

    hold_for: Duration = "5m"
    """Maximum time for which evictions of the active instance are refused after its node was cordoned. In this time,
    the monitor switches to an instance on another node. 0s: evictions are not refused. See docs/switchover.md."""


class Drain(Model):
    """What the operator reports to a monitor whose active instance runs on a node that is being drained."""

    uid: str
    """UID of the active instance's pod."""
    node: str
    """Name of the node."""
    since: float
    """When the operator saw that the node is drained, in unix seconds."""
    cordoned: list[str]
    """All nodes that are being drained. An understudy on one of them would have to move next."""
