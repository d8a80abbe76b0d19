"""With which strategy a recovery begins: not again with the one whose instance failed as soon as it was in control.

An application that crashes right after its start may be seen to drive for a moment. Each recovery by the same strategy
would then be verified, and the robot never be driven for long. How long is long enough the policy says (limits.healthyDelay).
"""

from __future__ import annotations

from dataclasses import dataclass

from understudy.failover.progress import Progress


@dataclass(frozen=True)
class _Latest:
    uid: str
    index: int
    verified: float


class Escalation:
    """Remembers the instance that took over last."""

    def __init__(self) -> None:
        self._latest: _Latest | None = None

    def note(self, done: Progress) -> None:
        """A recovery is over."""
        self._latest = None
        if done.result == "Recovered" and done.target is not None and done.taken_over is None and not done.follows:
            self._latest = _Latest(done.target.uid, done.index, done.moments.get("verified", done.cursor))

    def lived(self, uid: str, until: float) -> float | None:
        """Seconds for which an instance had been in control at a time (unix seconds); None where it isn't the one that took over
        last.
        """
        return until - self._latest.verified if self._latest is not None and self._latest.uid == uid else None

    def first(self, failed_uid: str, onset: float, strategies: int, *, healthy_delay: float) -> int | None:
        """Index of the strategy to begin with, of so many, after an instance has failed at a time (unix seconds).

        One that has been in control for less than ``healthy_delay`` seconds never worked. None where it was brought by the last of
        them: then it's time for a pause, and after that for the first one.
        """
        latest, self._latest = self._latest, None
        if latest is None or latest.uid != failed_uid or onset - latest.verified >= healthy_delay:
            return 0
        return latest.index + 1 if latest.index + 1 < strategies else None
