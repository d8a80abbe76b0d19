"""The recovery under way according to the gate's annotation, which is written before the status. Pure."""

from __future__ import annotations

from pydantic import Field

from understudy.api import names
from understudy.api.base import Model
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.cli.common.text.wording import listed, unix
from understudy.failover import progress as recoveries
from understudy.failover.progress import Committed, Progress, rfc3339
from understudy.kube.client import Object

_ROUNDING = 0.001
"""Greatest difference in seconds of the same time between gate and status."""


class UnderWay(Model):
    """Summary of a recovery under way."""

    reason: str = Field(description="What failed, or the other reason for the recovery.")
    occasion: str = Field(description="The reason of the condition Recovering.")
    since: str = Field(description="When the failure was detected.")
    strategy: str = Field(
        default="", description="The strategy that is tried; empty if the monitor does not report it."
    )
    pod: str | None = Field(default=None, description="The instance that takes over, if it is known.")
    waits_for: str | None = Field(default=None, description="The shared pool whose pod it waits for.")
    tried: list[str] = Field(default_factory=list, description="The strategies that failed, in order.")

    @classmethod
    def of(cls, progress: Progress) -> UnderWay:
        """Summarize the record."""
        return cls(
            reason=progress.reason,
            occasion=progress.occasion,
            since=rfc3339(progress.moments.get("detected", progress.began)),
            strategy=progress.strategy,
            pod=progress.target.name if progress.target is not None else None,
            waits_for=progress.waiting.pool if progress.waiting is not None else None,
            tried=list(dict.fromkeys(attempt.strategy for attempt in progress.attempts)),
        )

    @property
    def message(self) -> str:
        """Reason and progress in one sentence."""
        reason = self.reason.rstrip(".")
        if not self.strategy:
            return f"{reason}."
        if self.waits_for is not None:
            how = f"waits for a pod of {self.waits_for}"
        else:
            how = f"is tried with {self.pod}" if self.pod is not None else "is tried"
        return f"{reason}; {self.strategy} {how}{f', after {listed(self.tried)}' if self.tried else ''}."


def under_way(status: RobotWorkloadStatus, gate: Object | None, now: float) -> UnderWay | None:
    """Return the recovery that the gate records and the status does not report yet, or not in detail; None if there is none.

    Switchovers and deferred recoveries do not count: the status reports both at once. ``now`` is in unix seconds.
    """
    notes = (gate["metadata"].get("annotations") or {}) if gate is not None else {}
    found = recoveries.beside(notes.get(names.RECOVERY, ""))
    if found is None or found.switchover is not None or found.held:
        return None
    is_recovering = status.health == "Recovering"
    if is_recovering and status.failing_since is not None:
        # The recovery in the status may not have committed yet, and the gate may record an earlier one that was abandoned.
        is_recovering = found.moments.get("last_healthy", 0.0) >= unix(status.failing_since) - _ROUNDING
    listed_ones = recoveries.listed_recoveries(status.recoveries or [])
    under_way = recoveries.under_way(Committed.of(found), listed_ones, None if is_recovering else now)
    return UnderWay.of(found) if under_way else None
