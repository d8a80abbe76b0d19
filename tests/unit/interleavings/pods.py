"""What runs in a pod on its node."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tests.unit.interleavings.apiserver import Place
from understudy.agent.agent_memory import AgentMemory

PERIOD = 0.05
"""Seconds between two samples of an application."""

_MOMENT = 1e-6
"""Seconds within which two times are the same."""

REFERRED = "of"
"""Label of pods that a Deployment or StatefulSet makes, with the workload that refers to it: they have none of ours at first."""


@dataclass
class Running:
    """A pod's processes on its node."""

    uid: str
    name: str
    place: Place
    node: str
    robot: str
    """The workload whose robot it sends to; empty while it's held."""
    held: bool
    ip: str
    up: bool = False
    """Whether its containers run."""
    sends: bool = False
    """Whether its application is healthy: what it sends, it sends now."""
    sends_since: float = 0.0
    broken: bool = False
    """Whether it will never send."""
    frozen: bool = False
    """Whether its application stands still: no procedure finds anything there."""
    ended: bool = False
    up_at: float | None = None
    exists: bool = True
    """Whether there is an object of it still."""
    through: bool = False
    """Whether what it sends reaches the robot."""
    through_since: float = -1.0
    harmed: bool = False
    """Whether it has failed in any way, or its node or agent has, or it was in control."""
    well_since: float = 0.0
    """Since when its application has been healthy and its process the same; infinite for one that was started again."""
    phase: float = 0.0
    """When it sends, of each period."""
    period: float = PERIOD
    """Seconds between two of its samples."""
    heard_last: float = -1.0
    """When its last sample arrived, before those that arrive now."""
    routed_at: float | None = None
    restarts: int = 0
    brought: str = ""
    """What a procedure has brought its processes to, as its monitor called it."""
    silent_since: float = 0.0
    """When it stopped sending."""
    disturbed: bool = False
    """Whether it sent until a procedure began, and will again when that ends."""
    owner: str = ""
    """The workload it was made for; empty in a shared pool."""
    secret: str = ""
    """With its agent's token; empty if it has no agent."""
    memory: AgentMemory = field(default_factory=AgentMemory)
    """In its volume: what its agent remembers."""

    @property
    def stands_by(self) -> bool:
        """Whether it is as far as a standby has to be: it may have to be activated before it sends."""
        return self.sends or (self.up and self.brought.startswith("init:") and not self.broken)

    def first_arrival(self, since: float, now: float) -> float | None:
        """When a sample of it first arrived at or after a time; of earlier ones only the last is known."""
        if self.heard_last >= since:
            return self.heard_last
        first = self.next_sample(max(since, self.through_since))
        return first if self.through and first <= now + _MOMENT else None

    def last_arrival(self, now: float) -> float | None:
        """When its last sample arrived; None if none did."""
        last = self.phase + math.floor((now - self.phase + _MOMENT) / self.period) * self.period
        if self.through and last >= self.through_since - _MOMENT:
            return last
        return self.heard_last if self.heard_last >= 0 else None

    def next_sample(self, since: float) -> float:
        """When it sends at or after a time."""
        return self.phase + math.ceil((since - self.phase - _MOMENT) / self.period) * self.period


@dataclass
class Luck:
    """The fates of new pods."""

    broken: float = 0.0
    slow: float = 0.1
    failing: float = 0.0
    """And of procedures."""
