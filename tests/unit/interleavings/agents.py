"""What the reflex needs in the pods: the profile that says how strong a process is, and the fence that holds one which is cut off.

Both are the agent's own code, over a folder for the pod's shared volume. Stand-ins are the connections with which the fence
asks whether anybody is there, and the application, which does at once as the shared volume says.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.unit.interleavings.ownership import PERIOD, Writer
from understudy.agent import prepare as preparing
from understudy.agent.isolation import ANSWER, Address, ConnectionAttempts, Isolation
from understudy.agent.writer_strength import WriterStrengths
from understudy.api import names

ANSWERS = 0.002
"""Seconds until a connection is accepted or refused."""

_STRENGTH = re.compile(r"<ownershipStrength><value>(\d+)</value>")


class Questions(ConnectionAttempts):
    """Connections to whoever may answer."""

    def __init__(self, reaches: Callable[[str], bool]) -> None:
        """``reaches`` tells whether an address is reached now."""
        super().__init__()
        self._reaches = reaches
        self._asked: list[tuple[Address, float, bool]] = []

    def ask(self, address: Address, now: float) -> None:
        """Begin to connect."""
        self._asked.append((address, now, self._reaches(address.host)))

    def answers(self, now: float) -> list[tuple[Address, float, bool]]:
        """The results of those that have ended."""
        ended = [one for one in self._asked if now - one[1] >= (ANSWERS if one[2] else ANSWER)]
        self._asked = [one for one in self._asked if one not in ended]
        return ended

    def close(self) -> None:
        """Give them all up."""
        self._asked.clear()


@dataclass
class Sessions:
    """The connections with monitors."""

    there: Callable[[], bool]
    """Whether a monitor is reached."""
    number: int = 0
    """Another one for every connection."""

    @property
    def count(self) -> int:
        return int(self.there())

    def delivered(self) -> bool:
        return self.there()

    def abort(self) -> None:
        self.number += 1


@dataclass
class Agent:
    """What belongs to one pod, from when its processes are prepared."""

    pod: str
    """Its UID."""
    folder: Path
    strengths: WriterStrengths
    isolation: Isolation
    sessions: Sessions
    phases: Callable[[], float]
    processes: itertools.count[int] = field(default_factory=lambda: itertools.count(1))
    process: int = 0
    """Which one runs, or did last."""
    writer: Writer | None = None
    """Of the process that runs; None where no reader accepts it."""
    hangs: bool = False
    """Whether the application stands still, and goes on later."""
    silent_since: float = 0.0
    """When it stood still or froze."""
    reaches_since: float | None = None
    """Since when what it sends reaches its robot; None while it doesn't."""
    gave_way: int | None = None
    """The process that ran when the agent received the order to give way."""
    believed: bool = False
    """Whether it was let go on last before the gate had shut it out, or before its monitor knew that."""
    unfenced: bool = False
    """Whether it was last disconnected before a monitor had sent its agent the list of witnesses."""
    left: bool = False
    """Whether its processes were stopped in order, so that readers know."""
    asking: bool = False
    """Whether its fence runs: while everybody answers there is nothing to decide."""

    def prepare(self, profile: str) -> None:
        """As the init container does."""
        preparing.write(profile, self.folder, self.pod)

    def begin(self) -> None:
        """A process of the application starts: it reads its profile."""
        self.process, self.writer = next(self.processes), None
        text = (self.folder / names.PROFILES_KEY).read_text()
        found = _STRENGTH.search(text)
        assert found is not None
        # A reader that has a deadline takes nobody who offers none.
        if "<deadline>" in text:
            self.writer = Writer(self.pod, int(found[1]), self.phases() * PERIOD)

    def see_writers(self) -> None:
        """The agent sees the writers of the process that runs."""
        if self.process:
            self.strengths.saw([f"{self.pod[-8:]:>8}{self.process:04}".encode()])

    def give_way(self) -> None:
        """A monitor has asked for it."""
        self.strengths.give_way()
        if self.gave_way is None:
            self.gave_way = self.process

    @property
    def holds(self) -> bool:
        """Whether the application is stopped."""
        return self.isolation.since is not None
