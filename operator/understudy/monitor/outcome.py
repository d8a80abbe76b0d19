"""The outcome of a recovery or a planned switchover: the value that the act stage returns, and that every stage may
remember."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.progress import Progress

Kind = Literal["Recovered", "NothingVerified", "Superseded", "Stopped", "SwitchedOver", "NotSwitchedOver"]


@dataclass(frozen=True)
class Outcome:
    """One of these: an instance took over, no strategy was verified, another writer of the gate was first (Superseded), or the
    API server refused something (Stopped). Of a planned switchover: the understudy took over, or the former instance was
    let through again.
    """

    kind: Kind
    progress: Progress
    policy: FailurePolicySpec | None = None
    """The policy that it followed. None for switchovers, and if it ended before it began."""
    error: Exception | None = None
    """Why it was stopped or superseded."""

    @property
    def concluded(self) -> bool:
        """Whether it came to its end, and is recorded in the status."""
        return self.kind not in ("Superseded", "Stopped")

    @property
    def driven(self) -> bool:
        """Whether an instance is in control now."""
        return self.kind not in ("NothingVerified", "Stopped")

    @property
    def committed(self) -> float | None:
        """When the gate was opened for the instance that took over, in unix seconds; None if none did."""
        taken_over = self.kind in ("Recovered", "SwitchedOver")
        return self.progress.moments.get("committing") if taken_over else None
