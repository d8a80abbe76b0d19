"""What runs in a pod on its node."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.unit.interleavings.apiserver import Place
from understudy.agent.agent_memory import AgentMemory

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
    ended: bool = False
    up_at: float | None = None
    exists: bool = True
    """Whether there is an object of it still."""
    through: bool = False
    """Whether what it sends reaches the robot."""
    through_since: float = -1.0
    through_last: float = -1.0
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


@dataclass
class Luck:
    """The fates of new pods."""

    broken: float = 0.0
    slow: float = 0.1
    failing: float = 0.0
    """And of procedures."""
