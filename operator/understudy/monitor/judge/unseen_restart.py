"""Judges whether the active instance restarted in place while no monitor watched it.

It may be healthy again, but goes on from its own start: its state is lost. A monitor that watches sees that failure as silence.
"""

from __future__ import annotations

import time

from understudy.failover.interfaces import Instance
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.state.state_store import StateSource

REPORTED_WITHIN = 30.0
"""Seconds from the first output of a restarted process until the API server has the restart: longer after an outage. A later restart was
watched."""


UNWATCHED = 1.0
"""Seconds without a judgement, as while this process was stalled, in which an instance may have restarted unseen."""


class UnseenRestart:
    """Compares the active instance with the one from which an earlier monitor kept state, or this one before it was stalled."""

    def __init__(self, observer: HealthObserver, before: StateSource | None) -> None:
        self._observer, self._before = observer, before
        self._began = time.time()
        self._last: StateSource | None = None
        """From which instance and processes this monitor kept state last."""
        self._judged: float | None = None
        """When the instance was judged last (monotonic seconds)."""
        self._until: float | None = None
        """Until when (monotonic seconds) a restart counts as unseen; None before the first output."""

    def onset(self, active: Instance, now: float, *, keeps_state: bool = False) -> float | None:
        """Return when the restart became known, in Unix seconds: when this monitor began to watch, or went on. None if there was none.

        ``keeps_state`` is whether the policy keeps any: without it, nothing is lost that a recovery could restore.

        Restarts of the containers alone do not count, because the one that restarted may not be the one that drives. Nor do new processes
        alone, because a launch file may restart a node, and the health tree says whether that is a failure.
        """
        judged, self._judged = self._judged, time.monotonic()
        is_back = judged is not None and self._judged - judged >= UNWATCHED
        if is_back and self._before is None and keeps_state:
            self._before, self._began, self._until = self._last, now, None
        if (before := self._before) is None:
            return None
        heard = self._observer.processes(active.name)
        if self._until is None and heard:
            self._until = time.monotonic() + REPORTED_WITHIN
        is_over = self._until is not None and time.monotonic() > self._until
        if active.uid != before.uid or is_over:
            self.ignore()
            return None
        restarted = active.restarts > before.restarts and not heard <= before.processes
        return min(self._began, now) if restarted else None

    def ignore(self) -> None:
        """Take the active instance as it is."""
        self._before = None
        self.rest()

    def rest(self) -> None:
        """Start to judge again: no instance was active, or a recovery has ended, which knows what it did."""
        self._judged = self._last = None

    def source(self, active: Instance) -> StateSource:
        """Return from which instance and processes state is kept now: still the earlier ones while a restart may become known."""
        self._last = self._before or StateSource(active.uid, active.restarts, self._observer.processes(active.name))
        return self._last
