"""The outcome of a recovery or a planned switchover: the value that the act stage returns to all stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.clock import CLOCK
from understudy.failover.progress import PodIdentity, Progress

Kind = Literal[
    "Recovered", "NothingVerified", "Superseded", "Stopped", "NoLongerNeeded", "SwitchedOver", "NotSwitchedOver"
]


@dataclass(frozen=True)
class Outcome:
    """How a recovery ended: an instance took over, no strategy was verified, another writer of the gate was first (Superseded), or
    the API server refused something (Stopped), or the failed instance was healthy again before anything was changed
    (NoLongerNeeded). Or how a planned switchover ended: the understudy took over, or the gate was
    opened for the former instance again.
    """

    kind: Kind
    progress: Progress
    policy: FailurePolicySpec | None = None
    """The policy of the recovery. None for switchovers, and for a recovery that ended before its first strategy."""
    error: Exception | None = None
    """Why the recovery was stopped, superseded or not needed."""

    @property
    def concluded(self) -> bool:
        """Whether the recovery was carried out to its end, so that the status lists it."""
        return self.kind not in ("Superseded", "Stopped", "NoLongerNeeded")

    @property
    def left(self) -> Sequence[PodIdentity]:
        """The pods that this recovery has put out of control, and that are to be deleted. The gate's record need not have them: somebody
        may have fenced the robot or deleted the gate since."""
        if self.kind in ("NoLongerNeeded", "NothingVerified"):
            return ()
        if self.concluded:
            return self.progress.replaced
        return self.progress.failed if {"fenced", "committed"} & self.progress.moments.keys() else ()

    @property
    def driven(self) -> bool:
        """Whether an instance is active now."""
        return self.kind not in ("NothingVerified", "Stopped")

    @property
    def committed(self) -> float | None:
        """When the gate was opened for the instance that took over, in Unix seconds; None if none took over."""
        return self._when_taken_over("committing")

    @property
    def verified(self) -> float | None:
        """When the instance that took over was seen to drive alone, in Unix seconds; None if none was."""
        return self._when_taken_over("verified")

    def _when_taken_over(self, moment: str) -> float | None:
        at = self.progress.moments.get(moment) if self.kind in ("Recovered", "SwitchedOver") else None
        return CLOCK.to_system(at) if at is not None else None
