"""Holds a recovery for as long as the policy's budget is spent, or a pause is in force: what failed is fenced, and that is all.

It stands beside the gate, so that the next monitor goes on holding it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from understudy.api.kinds.robot_workload import GateStatus
from understudy.failover.interfaces import Gate, Superseded
from understudy.failover.progress import Progress
from understudy.monitor.decide.limits import Limits
from understudy.monitor.notices import Notices
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.report.black_box import BlackBox

LOOK = 1.0
"""Seconds between two looks whether it may go on."""


class Holding:
    """Holds the recoveries of one workload."""

    def __init__(
        self,
        view: View,
        gate: Gate,
        notices: Notices,
        black_box: BlackBox,
        limits: Limits,
        current: CurrentRecovery,
        save: Callable[[Progress], None],
        meanwhile: Callable[[], None],
    ) -> None:
        """``save`` writes a recovery down; ``meanwhile`` does with each look what isn't to stand still."""
        self._view, self._gate, self._notices, self._black_box = view, gate, notices, black_box
        self._limits, self._current = limits, current
        self._save, self._meanwhile = save, meanwhile

    async def until_allowed(self, progress: Progress) -> None:
        """Return once it may be carried out. Where the policy's budget is spent that is known once it isn't any more.

        Raises Superseded, and what the API server answers.
        """
        now = time.time()
        nothing_failed = progress.planned or bool(progress.follows)
        begun = "decided" in progress.moments or progress.attempts or progress.taken_over is not None
        held = "held" in progress.moments
        waits = self._must_wait(now) if held else self._limits.spending.spent_until(now) is not None
        if waits and not begun and not nothing_failed:
            try:
                await self._hold(progress)
            except Exception:
                self._black_box.end(progress)
                raise
        if progress.held:
            progress.release(time.time())
            self._notices.event("Normal", "RecoveryReleased", f"{progress.reason}; it is recovered now")

    async def _hold(self, progress: Progress) -> None:
        """Fence what failed, and do no more: the robot is told the safe commands meanwhile."""
        progress.moments.setdefault("held", time.time())
        self._save(progress)
        self._black_box.begin(progress)
        with self._current.during(progress, held=True):
            if not self._gate.state.closed:
                await self._gate.commit(None, progress)
            progress.moments.setdefault("fenced", time.time())
            epoch = self._gate.state.epoch
            self._notices.set(active="", health="Failed", gate=GateStatus(epoch=epoch))
            self._notices.condition("Healthy", "False", "Failed", progress.reason)
            self._limits.spending.say(time.time())
            self._limits.spending.tell_held(progress)
            while self._must_wait(time.time()):
                if (found := self._gate.state.epoch) != epoch:
                    raise Superseded(f"the gate is at epoch {found} by another writer, and was at {epoch}")
                self._meanwhile()
                await asyncio.sleep(LOOK)

    def _must_wait(self, now: float) -> bool:
        self._limits.pauses.look(now)
        if self._view.retired:
            return False
        return self._limits.pauses.on is not None or self._limits.spending.spent_until(now) is not None
