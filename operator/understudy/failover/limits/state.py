"""Which limits are in force at one instant. Times are unix seconds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ActiveLimit:
    """A limit that is in force."""

    words: str = ""
    """Details for the message of the decision."""
    until: float | None = None
    """When it ends by itself; None if that is not known."""


ROBOT_AWAY = ActiveLimit("no mux reports at the robot, so no other instance would reach it")


@dataclass(frozen=True)
class LimitsInForce:
    """The limits of a workload that are in force at one instant; None for a limit that is not."""

    pause: ActiveLimit | None = None
    waiting: ActiveLimit | None = None
    """The cooldown after a recovery, or the backoff after one without success."""
    storm: ActiveLimit | None = None
    budget: ActiveLimit | None = None
    """The budget is spent."""
    away: ActiveLimit | None = None
    """The robot cannot be reached: whatever an instance receives or sends, no other one would do better."""
