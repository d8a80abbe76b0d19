"""Selects the strategy that a recovery starts with, and skips one whose instance failed as soon as it was active; pure.

An application that crashes right after its start may still be seen to drive for a moment. Each recovery with the same strategy would then
verify, and the robot would never be driven for long. limits.healthyDelay defines how long is long enough. Times are of the process's
clock (understudy.clock): a step of the system's clock does not change how long an instance was active.
"""

from __future__ import annotations

from dataclasses import dataclass

from understudy.failover.progress import Progress


@dataclass(frozen=True)
class Takeover:
    """The instance that took over last."""

    uid: str
    index: int
    """Index of the strategy that activated it."""
    verified: float

    @classmethod
    def of(cls, done: Progress) -> Takeover | None:
        """Return the takeover of a finished recovery; None if it does not count against a strategy."""
        if done.result != "Recovered" or done.target is None or done.taken_over is not None or done.follows:
            return None
        return cls(done.target.uid, done.index, done.moments.get("verified", done.cursor))

    def lived(self, uid: str, until: float) -> float | None:
        """Return for how many seconds the instance had been active at a time; None for any other instance."""
        return until - self.verified if self.uid == uid else None


def first_strategy(
    latest: Takeover | None, failed_uid: str, onset: float, strategies: int, *, healthy_delay: float
) -> int | None:
    """Return the index of the strategy to start with after an instance failed.

    An instance that was active for less than ``healthy_delay`` seconds never worked: the next strategy is used. None if the last
    strategy activated it: then a backoff comes first, and after that the first strategy.
    """
    if latest is None or latest.uid != failed_uid or onset - latest.verified >= healthy_delay:
        return 0
    return latest.index + 1 if latest.index + 1 < strategies else None
