"""Marks abandoned recoveries in the record at the gate, so that they do not count as under way and commit nothing later.

The first commit of a recovery writes a record at the gate. The recovery counts as under way until the status lists it.
If an error of the API server stops the recovery, or another writer is first, the status never lists it. Workloads that
depend on this one would wait for its end, and so would workloads that wait for the same shared pool. The same holds for
a recovery whose monitor is gone and that nobody has recorded, such as that of the older of two monitors of this
workload.

A commit that had no answer may reach the API server later, when the instance that it fences is healthy again. A write to the gate makes the
API server refuse it from then on.

Both are written in the background while no recovery is under way, and each write is repeated until the gate has it. A
recovery never waits for the mark: at worst its commit is refused once, because the mark was written first, and is sent
again.
"""

from __future__ import annotations

import asyncio
import logging
import time

from understudy.failover.abandoned import AbandonedRecovery
from understudy.failover.progress import LASTS, Progress, beside
from understudy.kube.gates.base import GateRecord
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects import interrupted_recovery

_logger = logging.getLogger(__name__)


class Abandonment:
    """The abandoned recoveries of one workload, each for as long as the record at the gate may show it as under way."""

    def __init__(self, gate: GateControl, journal: RecoveryJournal, notices: Notices) -> None:
        self._gate, self._journal, self._notices = gate, journal, notices
        self._kept: list[AbandonedRecovery] | None = None
        """The abandoned recoveries; None until those of an earlier monitor were read from the journal."""
        self._left: tuple[str, float] = ("", 0.0)
        """The unconcluded recovery in the gate's record, and since when (monotonic seconds) the record has had it while
        the active instance was healthy."""
        self._writing: asyncio.Task[None] | None = None

    @property
    def ids(self) -> set[str]:
        """Ids of the recoveries that a new monitor does not continue."""
        self._forget_past_ones()
        return {one.id for one in self._known}

    def abandon(self, progress: Progress) -> None:
        """Note that a recovery is abandoned, for this monitor and for the one in the next container."""
        self._note(progress)
        self._journal.forget()

    def _note(self, progress: Progress) -> None:
        left = self._gate.left_by(progress.id)
        if left is None:
            return  # the recovery never reached the gate
        # The gate may still have the record of an earlier abandoned recovery, if the commit of this one was not carried out.
        record = self._gate.record
        there = [one for one in self._known if record is not None and one.matches(record.epoch, record.recovery)]
        self._keep([*(one for one in there if one.id != left.id), left])

    def update(self) -> None:
        """Write what the gate's record lacks of that. Called at intervals while no recovery is in progress; returns at once."""
        self._forget_past_ones()
        record = self._gate.record
        if record is None or (self._writing is not None and not self._writing.done()):
            return
        given_up = any(one.matches(record.epoch, record.recovery) for one in self._known)
        if self._is_left(record.recovery) or given_up:
            self._writing = asyncio.create_task(self._gate.end_recovery(record))
        elif self._known:  # what is left of them is a commit that may still be carried out
            self._writing = asyncio.create_task(self._overtake(record))

    async def _overtake(self, record: GateRecord) -> None:
        overtaken = list(self._known)
        if await self._gate.overtake(record, overtaken[-1]):
            self._keep([one for one in self._known if one not in overtaken])

    def _is_left(self, text: str) -> bool:
        """Return whether this recovery was left behind: its monitor would have recorded it by now, because the active instance has been
        healthy for LASTS seconds."""
        driven = self._notices.status.health in ("Healthy", "Degraded")
        # Switchovers are concluded elsewhere (understudy.monitor.act.recovery.planned_switchover).
        if interrupted_recovery.unconcluded(self._gate, self._notices.status) is None:
            text = ""
        now = time.monotonic()
        if not driven or not text or self._left[0] != text:
            self._left = (text if driven else "", now)
            return False
        return now - self._left[1] >= LASTS

    @property
    def _known(self) -> list[AbandonedRecovery]:
        if self._kept is None:
            self._kept = self._journal.journal.given_up()
        return self._kept

    def _forget_past_ones(self) -> None:
        """Forget the recoveries that the gate's record does not show as under way, and can no longer show."""
        record = self._gate.record
        if record is None or not self._known:
            return
        found = beside(record.recovery)
        concluded = found.id if found is not None and found.result != "Running" else ""
        left = [
            one
            for one in self._known
            if one.id != concluded
            and (one.matches(record.epoch, record.recovery) or one.may_still_commit(record.epoch))
        ]
        if left != self._known:
            self._keep(left)

    def _keep(self, given_up: list[AbandonedRecovery]) -> None:
        self._kept = given_up
        try:
            self._journal.journal.give_up(given_up)
        except OSError as error:
            _logger.error("storing the abandoned recoveries failed: %s", error)
