"""A recovery as the workload's status records it, with its moments as unix seconds, beside what the robot saw of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from understudy_demo.robotview import Handover, RobotLog

PARTS = ("detection", "cluster", "startup", "reinitialization")
"""The four parts of a recovery time, in the order of the paper's equation 1."""

OVERLAP_ALLOWED = 0.1
"""How long two pods' commands may both arrive before it counts as wrong, in seconds: far more than any engine that
enforces a policy at once needs, and less than what a robot would notice."""


def unix(moment: str) -> float:
    """An RFC 3339 moment as unix seconds."""
    return datetime.fromisoformat(moment).timestamp()


@dataclass(frozen=True)
class Recovered:
    """One entry of ``status.recoveries``."""

    number: int
    reason: str
    result: str
    strategy: str
    old: str
    new: str
    epoch: int
    seconds: float | None
    """The recovery time, last healthy output to routed, as recorded."""
    parts: dict[str, float]
    """Seconds by part, as in :data:`PARTS`; empty where none were recorded."""
    moments: dict[str, float]
    """Unix seconds by moment: lastHealthy, detected, decided, fenced, claimed, started, ready, routed, firstOutput,
    verified, as far as they happened."""
    attempts: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Recovered:
        """From the status as the API server gives it."""
        recorded = entry.get("parts") or {}
        return cls(
            number=int(entry.get("number", 0)),
            reason=str(entry.get("reason", "")),
            result=str(entry.get("result", "")),
            strategy=str(entry.get("strategy", "")),
            old=str(entry.get("fromPod", "")),
            new=str(entry.get("toPod", "")),
            epoch=int(entry.get("epoch", 0)),
            seconds=entry.get("recoverySeconds"),
            parts={part: float(recorded[part]) for part in PARTS if part in recorded},
            moments={name: unix(moment) for name, moment in (entry.get("moments") or {}).items() if moment},
            attempts=list(entry.get("attempts") or []),
        )

    @property
    def start(self) -> float | None:
        """What its times count from: the last healthy output, else its detection."""
        return self.moments.get("lastHealthy", self.moments.get("detected"))

    @property
    def earliest_switch(self) -> float | None:
        """The earliest moment at which the new pod may rightly have reached the robot.

        The gate opens for it after the decision, and where it had to be claimed, started and made ready, after that.
        ``routed`` itself is when the gate was seen to be open, so commands may rightly arrive a little before it.
        """
        routed = self.moments.get("routed", float("inf"))
        steps = [self.moments[name] for name in ("decided", "claimed", "started", "ready") if name in self.moments]
        return max((moment for moment in steps if moment <= routed), default=None)

    def handover(self, log: RobotLog) -> Handover:
        """How control passed at the robot."""
        return log.handover(self.old, self.new, switch=self.earliest_switch)

    def problems(self, handover: Handover, *, strategy: str | None = None) -> list[str]:
        """What was wrong with it; ``strategy`` is the one that should have recovered it."""
        if self.result != "Recovered":
            tried = "; ".join(f"{a.get('strategy')}: {a.get('result')}, {a.get('message')}" for a in self.attempts)
            return [f"recovery {self.number} ended as {self.result} ({tried or 'nothing was tried'})"]
        found = []
        if strategy is not None and self.strategy != strategy:
            found.append(f"recovered by {self.strategy} where {strategy} was expected")
        if handover.first_new is None:
            found.append(f"no command of {self.new} reached the robot")
        if handover.early:
            found.append(f"{len(handover.early)} commands of {self.new} reached the robot before the switch")
        if handover.overlap > OVERLAP_ALLOWED:
            found.append(
                f"commands of {self.old} arrived for {handover.overlap:.3f} s after the first of {self.new}, "
                f"at most {OVERLAP_ALLOWED} s may be"
            )
        return found
