"""One goal of a client, and its attempts at the instances."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

from understudy.clock import CLOCK

UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(7)
"""Values of action_msgs/msg/GoalStatus."""

AGAIN = 0.5
"""Seconds between two attempts at the active instance."""

MIRROR_AGAIN = 2.0
"""Seconds between two attempts at a standby."""

_PAST = ("received", "unasked_at", "refused_since", "ended_at")
"""The times of a goal that are never in the future; 0 if there is none."""


class Phase(Enum):
    """The state of a goal, for its client."""

    PENDING = "pending"
    """No instance has decided yet whether to accept it."""
    ACTIVE = "active"
    CANCELING = "canceling"
    ENDED = "ended"


class AttemptState(Enum):
    """The state of a goal at an instance."""

    SENT = "sent"
    RUNNING = "running"
    REJECTED = "rejected"
    ENDED = "ended"
    LOST = "lost"
    """The application was restarted and no longer knows the goal."""


@dataclass
class Attempt:
    """A goal at one instance, under the id that it has there."""

    id: str
    at: AttemptState = AttemptState.SENT
    status: int = UNKNOWN
    """The status with which it ended there."""
    after: float = 0.0
    """From when it may be tried there again."""
    withdrawn: bool = False
    """Whether the instance is to cancel it, because it was no longer in charge. That is no end of the goal."""

    @property
    def open(self) -> bool:
        """Whether the instance has the goal, or may have it."""
        return self.at in (AttemptState.SENT, AttemptState.RUNNING)

    @property
    def may_be_offered(self) -> bool:
        """Whether the instance may offer it to a proxy that does not know the goal, as one that was withdrawn or aborted."""
        return self.at is AttemptState.ENDED and (self.withdrawn or self.status in (CANCELED, ABORTED))


@dataclass(frozen=True)
class GoalEnd:
    """The end of a goal."""

    status: int
    result: str
    """Serialized, in base64; empty for a result without content."""


@dataclass
class Goal:
    """One goal. Times are of the process's clock (understudy.clock).

    ``accepted`` is of the system's clock, because ROS messages carry it.
    """

    id: str
    action: str
    data: str
    """The serialized goal, in base64."""
    number: int
    """Its position in the order in which goals arrived."""
    received: float
    request: tuple[str, int] | None = None
    """The client's request that is to be answered (see ros/runtime/service_exchange.py)."""
    phase: Phase = Phase.PENDING
    accepted: int = 0
    """When it was accepted, in Unix nanoseconds."""
    charge: str = ""
    """UID of the instance that decides about the goal; empty if none does."""
    attempts: dict[str, Attempt] = field(default_factory=dict)
    """The latest attempt at each instance, by the UID of the instance."""
    cancels: list[tuple[str, int]] = field(default_factory=list)
    """Clients' requests to cancel it that the instance has not answered yet."""
    results: list[tuple[str, int]] = field(default_factory=list)
    """Clients' requests for its result."""
    unasked: GoalEnd | None = None
    """An end that no client requested and that may be part of a failure. The client does not know of it yet."""
    unasked_at: float = 0.0
    refused_since: float = 0.0
    """Since when instances that received the goal in a failover have rejected it; 0 if they have not."""
    end: GoalEnd | None = None
    ended_at: float = 0.0

    @property
    def open(self) -> bool:
        """Whether the goal has not ended yet."""
        return self.phase is not Phase.ENDED

    @property
    def is_cancelled(self) -> bool:
        """Whether a client has requested to cancel it, and the instance has accepted that or has not answered yet."""
        return self.phase is Phase.CANCELING or bool(self.cancels)

    @property
    def status(self) -> int:
        """The status as an action server reports it.

        A goal that no instance works on at the moment is accepted, not executing.
        """
        if self.end is not None:
            return self.end.status
        if self.phase is Phase.CANCELING:
            return CANCELING
        attempt = self.attempts.get(self.charge)
        working = self.unasked is None and attempt is not None and attempt.at is AttemptState.RUNNING
        return EXECUTING if working else ACCEPTED

    def attempt(self, uid: str) -> Attempt:
        """Start an attempt at an instance.

        Its id is the client's own. If that was already used there, it follows from the last one, so that each proxy that knows the last
        attempt gives the next one the same id, and the instance executes it once. A goal that it has rejected gets another id too: the
        instance takes a known id for a late order, or for one of another proxy.
        """
        before = self.attempts.get(uid)
        made = Attempt(self.id if before is None else uuid.uuid5(uuid.UUID(before.id), uid).hex)
        self.attempts[uid] = made
        return made

    def note(self) -> str:
        """Return the note that an instance keeps with the goal. A proxy without a journal can adopt the goal from this note."""
        # Only proxies of earlier versions read ``received``.
        kept = ("id", "action", "number", "received", "request", "accepted", "results")
        return json.dumps({name: getattr(self, name) for name in kept})

    @classmethod
    def from_note(cls, note: str, data: str, now: float) -> Goal:
        """Read a note. Raises KeyError, TypeError and ValueError if it is invalid.

        The goal counts as received now, because the clock of the machine that wrote the note is not this one's.
        """
        found = json.loads(note)
        request = tuple(found["request"]) if found["request"] else None
        results = [tuple(entry) for entry in found["results"]]
        goal = cls(**{**found, "data": data, "request": request, "results": results, "received": now})
        goal.phase = Phase.ACTIVE if goal.accepted else Phase.PENDING
        return goal

    def to_wire(self, step: float) -> dict[str, Any]:
        """Return the goal as one JSON object, with times of the system's clock, which is ``step`` seconds ahead of the process's clock."""
        wire = asdict(self)
        wire["phase"] = self.phase.value
        wire |= {name: wire[name] + step for name in _PAST if wire[name]}
        for attempt in wire["attempts"].values():
            attempt["at"] = attempt["at"].value
            attempt["after"] += step
        return wire

    @classmethod
    def from_wire(cls, data: Mapping[str, Any], now: float) -> Goal:
        """Read the JSON object. Raises KeyError, TypeError and ValueError if it is invalid.

        If the clock was set back since it was written, its times count as the latest ones that are possible.
        """
        goal = cls(**{key: value for key, value in data.items() if key != "tries"})  # of an earlier version
        for name in _PAST:
            if moment := getattr(goal, name):
                setattr(goal, name, min(CLOCK.of_system(moment), now))
        goal.phase = Phase(data["phase"])
        goal.attempts = {uid: Attempt(**{**a, "at": AttemptState(a["at"])}) for uid, a in data["attempts"].items()}
        for attempt in goal.attempts.values():
            attempt.after = min(CLOCK.of_system(attempt.after), now + MIRROR_AGAIN)
        goal.end = GoalEnd(**data["end"]) if data["end"] else None
        goal.unasked = GoalEnd(**data["unasked"]) if data["unasked"] else None
        goal.request = tuple(data["request"]) if data["request"] else None
        goal.cancels = [tuple(entry) for entry in data["cancels"]]
        goal.results = [tuple(entry) for entry in data["results"]]
        return goal
