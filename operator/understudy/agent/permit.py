"""The permit of an instance to act: every answer of another party renews it, and without answers it expires.

While an instance is isolated, another one may take control. The policies on the node of the isolated instance do not know
that when the node is connected again. So an instance that nobody answers is frozen, which costs nothing: it cannot reach its
robot either. Afterwards only the monitor, or the API server after a while, lets it continue.

This module reads no clock and no socket: events come with their time, in monotonic seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

RENEW_PERIOD = 0.125
"""Seconds between two questions to the party that answered last."""

RETRY = 0.1
"""Seconds without an answer after which all parties are asked."""

IDLE_PERIOD = 1.0
"""Seconds between two rounds before anybody has ever answered."""

FROZEN_PERIOD = 0.25
"""Seconds between two rounds while the instance is frozen."""

PATIENCE = 0.4
"""Seconds without any answer after which the instance is frozen; 0.45 at most if this process is not late."""

ROUNDS = 2
"""Minimum number of rounds without any answer before the instance is frozen; each lasts RETRY seconds."""

STALLED = 0.25
"""Delay of an evaluation, in seconds, that shows that this process was stalled. Then everybody is asked again first."""

WITHOUT_MONITOR = 30.0
"""Seconds for which the API server must have been reached before a frozen instance continues without a monitor's decision."""

Instruction = Literal["Go", "Stay"]
"""The monitor's decision about an instance. Go: it is active or a standby. Stay: it was replaced."""

Questioned = Literal["Nobody", "One", "Everybody"]

State = Literal["Idle", "Running", "Isolated", "Reconnected", "Replaced"]
"""Idle: nobody has ever answered, so silence means nothing. Running: somebody answers. Isolated: frozen, nobody answers.
Reconnected: frozen, answers arrive again, the monitor has not decided yet. Replaced: frozen for good."""

FROZEN: frozenset[State] = frozenset({"Isolated", "Reconnected", "Replaced"})


@dataclass
class Permit:
    """The permit of one instance."""

    state: State = "Idle"
    answered_at: float = 0.0
    """When somebody answered last."""
    waiting: bool = False
    """Whether somebody was asked since the last answer."""
    rounds: int = 0
    """Rounds of questions since the last answer."""
    asked_at: float = 0.0
    """When somebody was asked last."""
    evaluated_at: float | None = None
    apiserver_since: float | None = None
    """Since when every attempt has reached the API server; None while attempts fail."""

    @property
    def frozen(self) -> bool:
        """Whether the application must not run."""
        return self.state in FROZEN

    @property
    def wait(self) -> float:
        """Seconds until the next evaluation."""
        if self.state == "Idle":
            return IDLE_PERIOD
        if self.frozen:
            return FROZEN_PERIOD
        return RETRY if self.rounds else RENEW_PERIOD

    def answered(self, now: float) -> None:
        """Note that somebody answered."""
        self.answered_at, self.rounds, self.waiting = now, 0, False
        match self.state:
            case "Idle":
                self.state = "Running"
            case "Isolated":
                self.state = "Reconnected"

    def ask(self, now: float) -> Questioned:
        """Return whom to ask now, and record the question."""
        if self.state == "Replaced":
            return "Nobody"
        everybody = self.waiting or self.state in ("Idle", "Isolated")
        self.waiting, self.asked_at = True, now
        if not everybody:
            return "One"
        self.rounds += 1
        return "Everybody"

    def apiserver(self, now: float, reached: bool) -> None:
        """Note whether the API server accepted a connection."""
        if not reached:
            self.apiserver_since = None
        elif self.apiserver_since is None:
            self.apiserver_since = now

    def instruct(self, instruction: Instruction, now: float) -> None:
        """Apply the monitor's decision about a frozen instance; its last decision counts."""
        if not self.frozen:
            return
        self.answered(now)
        if instruction == "Stay":
            self.state = "Replaced"
        else:
            self._continue()

    def evaluate(self, now: float) -> None:
        """Evaluate the answers so far, before anybody is asked again."""
        stalled = self.evaluated_at is not None and now - self.evaluated_at > self.wait + STALLED
        self.evaluated_at = now
        if stalled:
            self.rounds, self.waiting = 0, False
            return
        silent = now - self.answered_at >= PATIENCE and self.rounds >= ROUNDS and now - self.asked_at >= RETRY * 0.9
        if silent and self.state in ("Running", "Reconnected"):
            self.state, self.apiserver_since = "Isolated", None
        elif (
            self.state == "Reconnected"
            and self.apiserver_since is not None
            and now - self.apiserver_since >= WITHOUT_MONITOR
        ):
            self._continue()

    def _continue(self) -> None:
        self.state, self.apiserver_since, self.rounds, self.waiting = "Running", None, 0, False
