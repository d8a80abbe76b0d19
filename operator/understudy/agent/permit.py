"""When an instance may no longer run: a lease that every answer of somebody else renews.

While an instance is cut off another one may be put in control, and what would keep it from the robot, the policies on its
own node, knows nothing of that when the node is connected again. So an instance to which nobody answers is held. That costs
nothing, since it doesn't reach its robot either. Afterwards only who decides about it can let it go on.

Nothing here looks at a clock or a socket: what is so comes in with its time, in monotonic seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

RENEW_PERIOD = 0.125
"""Seconds between two questions to the one who answered last."""

RETRY = 0.1
"""Seconds after which everybody is asked again, where no answer came."""

IDLE_PERIOD = 1.0
"""Seconds between two such rounds before anybody has ever answered."""

FROZEN_PERIOD = 0.25
"""Seconds between two such rounds once the instance is held."""

PATIENCE = 0.4
"""Seconds without any answer after which the instance is held; it takes 0.45 at most where this process isn't late."""

ROUNDS = 2
"""Times that everybody must have been asked in vain before; each has AGAIN seconds to answer."""

STALLED = 0.25
"""Seconds that a look comes late by, which say that this process was stalled: then everybody is asked anew before it is judged."""

WITHOUT_MONITOR = 30.0
"""Seconds for which the API server must have been reached before a held instance goes on with no word of a monitor."""

Instruction = Literal["Go", "Stay"]
"""What the monitor says of an instance: it drives or stands by, or it was replaced."""

Questioned = Literal["Nobody", "One", "Everybody"]

State = Literal["Idle", "Running", "Away", "Back", "Replaced"]
"""Idle: nobody has ever answered, so silence says nothing. Running: somebody answers. Away: held, nobody answers. Back: held,
answers come again, waiting for the monitor's word. Replaced: held for good."""

FROZEN: frozenset[State] = frozenset({"Away", "Back", "Replaced"})


@dataclass
class Permit:
    """One instance's."""

    state: State = "Idle"
    answered_at: float = 0.0
    """When somebody answered last."""
    waiting: bool = False
    """Whether somebody was asked since then."""
    rounds: int = 0
    """Times that everybody was asked since then."""
    asked_at: float = 0.0
    """When somebody was asked last."""
    looked_at: float | None = None
    apiserver_since: float | None = None
    """Since when the API server was reached whenever it was asked."""

    @property
    def held(self) -> bool:
        """Whether the application must not run."""
        return self.state in FROZEN

    @property
    def wait(self) -> float:
        """Seconds until the next look."""
        if self.state == "Idle":
            return IDLE_PERIOD
        if self.held:
            return FROZEN_PERIOD
        return RETRY if self.rounds else RENEW_PERIOD

    def answered(self, now: float) -> None:
        """Somebody answered."""
        self.answered_at, self.rounds, self.waiting = now, 0, False
        match self.state:
            case "Idle":
                self.state = "Running"
            case "Away":
                self.state = "Back"

    def ask(self, now: float) -> Questioned:
        """Whom to ask now. They are taken to be asked."""
        if self.state == "Replaced":
            return "Nobody"
        everybody = self.waiting or self.state in ("Idle", "Away")
        self.waiting, self.asked_at = True, now
        if not everybody:
            return "One"
        self.rounds += 1
        return "Everybody"

    def apiserver(self, now: float, reached: bool) -> None:
        """The API server was asked, and accepted a connection or didn't."""
        if not reached:
            self.apiserver_since = None
        elif self.apiserver_since is None:
            self.apiserver_since = now

    def word(self, word: Instruction, now: float) -> None:
        """The monitor said what becomes of a held instance; its last word counts."""
        if not self.held:
            return
        self.answered(now)
        if word == "Stay":
            self.state = "Replaced"
        else:
            self._go_on()

    def look(self, now: float) -> None:
        """Judge by what came until now, before anybody is asked again."""
        stalled = self.looked_at is not None and now - self.looked_at > self.wait + STALLED
        self.looked_at = now
        if stalled:
            self.rounds, self.waiting = 0, False
            return
        silent = now - self.answered_at >= PATIENCE and self.rounds >= ROUNDS and now - self.asked_at >= RETRY * 0.9
        if silent and self.state in ("Running", "Back"):
            self.state, self.apiserver_since = "Away", None
        elif (
            self.state == "Back" and self.apiserver_since is not None and now - self.apiserver_since >= WITHOUT_MONITOR
        ):
            self._go_on()

    def _go_on(self) -> None:
        self.state, self.apiserver_since, self.rounds, self.waiting = "Running", None, 0, False
