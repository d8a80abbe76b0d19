"""Maintenance (spec.pause); pure."""

from __future__ import annotations

from understudy.api.kinds.pause_spec import Pause
from understudy.failover.limits.state import ActiveLimit


def in_force(pause: Pause | None, now: float) -> ActiveLimit | None:
    """Return the pause if it is in force at a time (unix seconds): by whom, why and until when."""
    if pause is None or not pause.in_force(now):
        return None
    return ActiveLimit(pause.words, pause.end)
