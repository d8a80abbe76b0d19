"""One goal of a client, and what has become of it at the instances."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(7)
"""action_msgs/msg/GoalStatus."""


class Phase(Enum):
    """How a goal is, for its client."""

    PENDING = "pending"
    """No instance has decided yet whether to accept it."""
    ACTIVE = "active"
    CANCELING = "canceling"
    ENDED = "ended"


class AttemptState(Enum):
    """How a goal is, at an instance."""

    SENT = "sent"
    RUNNING = "running"
    REJECTED = "rejected"
    ENDED = "ended"
    LOST = "lost"
    """Its application was started again and no longer knows it."""


@dataclass
class Attempt:
    """A goal at one instance, under an id there."""

    id: str
    at: AttemptState = AttemptState.SENT
    status: int = UNKNOWN
    """With which it ended there."""
    after: float = 0.0
    """Unix seconds from which it may be tried again there."""

    @property
    def open(self) -> bool:
        """Whether the instance has it, or may have it."""
        return self.at in (AttemptState.SENT, AttemptState.RUNNING)


@dataclass(frozen=True)
class GoalEnd:
    """How a goal ended."""

    status: int
    result: str
    """Serialized, in base64; empty for one without content."""


@dataclass
class Goal:
    """One goal. Times are Unix seconds, ``accepted`` Unix nanoseconds."""

    id: str
    action: str
    data: str
    """The goal serialized, in base64."""
    number: int
    """Its place in the order in which goals came."""
    received: float
    request: tuple[str, int] | None = None
    """The client's request, which is to be answered (see ros/runtime/service_exchange.py)."""
    phase: Phase = Phase.PENDING
    accepted: int = 0
    charge: str = ""
    """UID of the instance whose word counts; empty while none does."""
    attempts: dict[str, Attempt] = field(default_factory=dict)
    """By the UID of the instance, the latest there."""
    tries: int = 0
    cancels: list[tuple[str, int]] = field(default_factory=list)
    """Clients' requests to cancel it that the instance has not answered yet."""
    results: list[tuple[str, int]] = field(default_factory=list)
    """Clients' requests for its result."""
    unasked: GoalEnd | None = None
    """An end that nobody asked for, which may be part of a failure: not told yet."""
    unasked_at: float = 0.0
    refused_since: float = 0.0
    """Since when instances have rejected it that were given it because of a failover; 0 if they have not."""
    end: GoalEnd | None = None
    ended_at: float = 0.0

    @property
    def open(self) -> bool:
        """Whether it has yet to end."""
        return self.phase is not Phase.ENDED

    @property
    def status(self) -> int:
        """As an action server says it. A goal that no instance works on at the moment is accepted, not executing."""
        if self.end is not None:
            return self.end.status
        if self.phase is Phase.CANCELING:
            return CANCELING
        attempt = self.attempts.get(self.charge)
        working = self.unasked is None and attempt is not None and attempt.at is AttemptState.RUNNING
        return EXECUTING if working else ACCEPTED

    def attempt(self, uid: str) -> Attempt:
        """Begin an attempt at an instance: under the client's own id, but under a new one if that was taken there."""
        before = self.attempts.get(uid)
        if before is None:
            made = Attempt(self.id)
        elif before.at is AttemptState.REJECTED:
            made = Attempt(before.id)
        else:
            self.tries += 1
            made = Attempt(uuid.uuid5(uuid.UUID(self.id), f"{uid} {self.tries}").hex)
        self.attempts[uid] = made
        return made

    def note(self) -> str:
        """What an instance is given to keep with the goal: by it a proxy without a journal takes the goal up."""
        kept = ("id", "action", "number", "received", "request", "accepted", "results")
        return json.dumps({name: getattr(self, name) for name in kept})

    @classmethod
    def from_note(cls, note: str, data: str) -> Goal:
        """Raises KeyError, TypeError and ValueError if it is none."""
        found = json.loads(note)
        request = tuple(found["request"]) if found["request"] else None
        results = [tuple(entry) for entry in found["results"]]
        goal = cls(**{**found, "data": data, "request": request, "results": results})
        goal.phase = Phase.ACTIVE if goal.accepted else Phase.PENDING
        return goal

    def to_wire(self) -> dict[str, Any]:
        """As one JSON object."""
        wire = asdict(self)
        wire["phase"] = self.phase.value
        for attempt in wire["attempts"].values():
            attempt["at"] = attempt["at"].value
        return wire

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Goal:
        """Raises KeyError, TypeError and ValueError if it is none."""
        goal = cls(**data)
        goal.phase = Phase(data["phase"])
        goal.attempts = {uid: Attempt(**{**a, "at": AttemptState(a["at"])}) for uid, a in data["attempts"].items()}
        goal.end = GoalEnd(**data["end"]) if data["end"] else None
        goal.unasked = GoalEnd(**data["unasked"]) if data["unasked"] else None
        goal.request = tuple(data["request"]) if data["request"] else None
        goal.cancels = [tuple(entry) for entry in data["cancels"]]
        goal.results = [tuple(entry) for entry in data["results"]]
        return goal
