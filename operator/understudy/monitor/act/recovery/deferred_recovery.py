"""Defers a recovery while the policy's budget is spent or a pause is in force: only fences the failed pod.

The record at the gate contains the deferral, so the next monitor continues it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator

from understudy.api.kinds.robot_workload import GateStatus
from understudy.clock import CLOCK
from understudy.failover.decide import Trigger
from understudy.failover.interfaces import Superseded
from understudy.failover.progress import Progress
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.decide.limits import Limits
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery

CHECK_PERIOD = 1.0
"""Seconds between two checks whether the recovery may continue."""


class DeferredRecovery:
    """Defers the recoveries of one workload."""

    def __init__(
        self, cluster: Cluster, limits: Limits, current: CurrentRecovery, journal: RecoveryJournal, notices: Notices
    ) -> None:
        self._view, self._gate, self._notices = cluster.view, cluster.gate, notices
        self._limits, self._current, self._journal = limits, current, journal

    async def until_allowed(self, progress: Progress) -> AsyncGenerator[None]:
        """Wait until the recovery may be carried out. Yields at each check, so that the caller can do other work.

        Raises Superseded, and what a request to the API server raises.
        """
        now = time.time()
        nothing_failed = progress.planned or bool(progress.follows)
        is_started = "decided" in progress.moments or progress.attempts or progress.taken_over is not None
        held = "held" in progress.moments
        waits = self._must_wait(now) if held else self._limits.hold(Trigger.DECIDED_RECOVERY, now)
        if waits and not is_started and not nothing_failed:
            with self._current.during(progress, held=True):
                epoch = await self._fence(progress)
                while self._must_wait(time.time()):
                    if (found := self._gate.state.epoch) != epoch:
                        raise Superseded(f"another process changed the gate from epoch {epoch} to {found}")
                    yield
                    await asyncio.sleep(CHECK_PERIOD)
        if progress.held:
            progress.release(CLOCK.now())
            self._notices.event("Normal", "RecoveryReleased", f"{progress.reason}; the monitor starts the recovery now")

    async def _fence(self, progress: Progress) -> int:
        """Close the gate and report the deferral. Returns the gate's epoch."""
        progress.moments.setdefault("held", CLOCK.now())
        self._journal.save(progress)
        if not self._gate.state.closed:
            await self._gate.commit(None, progress)
        progress.moments.setdefault("fenced", CLOCK.now())
        epoch = self._gate.state.epoch
        self._notices.set(active="", health="Failed", gate=GateStatus(epoch=epoch))
        self._notices.condition("Healthy", "False", "Failed", progress.reason)
        self._limits.spending.report(time.time())
        self._limits.spending.report_held(progress)
        return epoch

    def _must_wait(self, now: float) -> bool:
        self._limits.pauses.update(now)
        if self._view.retired:
            return False
        return self._limits.hold(Trigger.HELD_RECOVERY, now)
