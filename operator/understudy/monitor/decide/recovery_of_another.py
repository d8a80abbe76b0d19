"""Decides how long to wait for a recovery that another monitor of this workload carries out while the gate is closed.

Two monitors live at once if a node that Kubernetes has lost runs on. If the other monitor has stopped, this one finishes the recovery.
"""

from __future__ import annotations

import time

from understudy.failover.decide import Occurrence, Requirement, Trigger
from understudy.failover.progress import LASTS, Progress
from understudy.monitor.decide.strategy_options import StrategyOptions


class RecoveryOfAnother:
    """The recovery of another monitor that the gate's record names, and since when the record has been unchanged."""

    def __init__(self, options: StrategyOptions) -> None:
        self._options = options
        self._seen: tuple[str, int] = ("", 0)
        self._since = 0.0
        """When the record was first seen as it is now (monotonic seconds)."""

    def occurrence(self, found: Progress | None, *, may_continue: bool = True) -> Occurrence | None:
        """Return the trigger; None if no other monitor's recovery is under way. ``may_continue`` is whether that monitor may exist.

        A monitor that lives commits or records the end within the time of the strategies that are left, and the time for which it waits for
        a pod of a shared pool. After that, it counts as stopped.
        """
        seen = (found.id, found.epoch) if found is not None else ("", 0)
        if seen != self._seen:
            self._seen, self._since = seen, time.monotonic()
        if found is None:
            return None
        within = LASTS + sum(choice.verify_within for choice in self._options.choices()[found.index :])
        if found.waiting is not None:
            within += found.waiting.until - found.waiting.since
        unmet = None
        if may_continue and time.monotonic() - self._since < within:
            words = f"another monitor carries out recovery {found.id}; if it does not end within {within:.0f} s, this monitor continues it"
            unmet = Requirement("RecoveryUnderWay", words)
        return Occurrence(Trigger.INTERRUPTED_RECOVERY, found.reason, unmet=unmet)
