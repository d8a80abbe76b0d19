"""The recovery that a workload's gate tells of: with the first commit, and so before the status does; pure."""

from __future__ import annotations

from pydantic import Field

from understudy.api import names
from understudy.api.base import Model
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.cli.common.wording import listed, unix
from understudy.failover import progress as recoveries
from understudy.failover.progress import Committed, Progress, rfc3339
from understudy.kube.client import Object

_ROUNDING = 0.001
"""Seconds by which one moment may differ in the gate and in the status."""


class UnderWay(Model):
    """A recovery under way in short."""

    reason: str = Field(description="What failed, or what else it is for.")
    occasion: str = Field(description="The same in one word, as the reason of the condition Recovering.")
    since: str = Field(description="When it was detected.")
    strategy: str = Field(default="", description="The one that is tried; empty where its monitor doesn't say.")
    pod: str | None = Field(default=None, description="The instance that is to take over, where it is known already.")
    waits_for: str | None = Field(default=None, description="The shared pool that it waits for a pod of.")
    tried: list[str] = Field(default_factory=list, description="The strategies that came to nothing, in order.")

    @classmethod
    def of(cls, progress: Progress) -> UnderWay:
        """From the record."""
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
        """Why it is recovered, and how."""
        reason = self.reason.rstrip(".")
        if not self.strategy:
            return f"{reason}."
        if self.waits_for is not None:
            how = f"waits for a pod of {self.waits_for}"
        else:
            how = f"is tried with {self.pod}" if self.pod is not None else "is tried"
        return f"{reason}; {self.strategy} {how}{f', after {listed(self.tried)}' if self.tried else ''}."


def under_way(status: RobotWorkloadStatus, gate: Object | None, now: float) -> UnderWay | None:
    """The recovery that a gate tells of where the status doesn't yet, or says no more than that there is one; None for none.

    A switchover is none, since the robot is driven all the while, nor is one that is held: the status tells of both at once. ``now`` is
    unix seconds.
    """
    notes = (gate["metadata"].get("annotations") or {}) if gate is not None else {}
    found = recoveries.beside(notes.get(names.RECOVERY, ""))
    if found is None or found.switchover is not None or found.held:
        return None
    said = status.health == "Recovering"
    if said and status.failing_since is not None:
        # The one that the status means may not have committed yet: what the gate tells of may have been given up long before.
        said = found.moments.get("last_healthy", 0.0) >= unix(status.failing_since) - _ROUNDING
    told = recoveries.told_in(status.recoveries or [])
    under_way = recoveries.under_way(Committed.of(found), told, None if said else now)
    return UnderWay.of(found) if under_way else None
