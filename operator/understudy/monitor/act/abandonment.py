"""Has what stands beside the gate say that a recovery isn't gone on with, once it was given up.

A recovery is written beside the gate with its first commit, and counts as under way until the status tells of it. One that an error of
the API server has stopped, or that somebody else was faster than, never gets there. Workloads that depend on this one would wait for its
end, and so would those that wait for the same shared pool. So it is with one whose monitor is gone and that nobody has recorded, such as
the older one of two monitors of this workload.

It is written in the background while nothing is recovered, and tried again until the gate says so. A recovery never waits for
it: at the worst its commit is refused once, since this was first, and is sent again.
"""

from __future__ import annotations

import asyncio
import logging
import time

from understudy.failover.abandoned import GivenUp
from understudy.failover.progress import LASTS, Committed, Progress, beside, under_way
from understudy.monitor.act.gate_control import GateControl
from understudy.monitor.act.recovery_journal import RecoveryJournal
from understudy.monitor.notices import Notices

_logger = logging.getLogger(__name__)


class Abandonment:
    """The recoveries of one workload that were abandoned, for as long as the record at its gate may say otherwise."""

    def __init__(self, gate: GateControl, journal: RecoveryJournal, notices: Notices) -> None:
        self._gate, self._journal, self._notices = gate, journal, notices
        self._kept: list[GivenUp] | None = None
        """None until what an earlier monitor had given up was taken over."""
        self._left: tuple[str, float] = ("", 0.0)
        """What stands beside the gate of a recovery that isn't this monitor's, and since when (monotonic seconds)."""
        self._saying: asyncio.Task[None] | None = None

    @property
    def ids(self) -> set[str]:
        """Those that a new monitor doesn't go on with."""
        self._forget_past_ones()
        return {one.id for one in self._known}

    def abandon(self, progress: Progress) -> None:
        """Mark a recovery as one that nobody finishes, here or in the next container."""
        self._note(progress)
        self._journal.forget()

    def _note(self, progress: Progress) -> None:
        left = self._gate.left_by(progress.id)
        if left is None:
            return  # it hadn't come to the gate
        # An earlier one may stand there still: this one needn't have come further than to ask for a commit.
        record = self._gate.record
        there = [one for one in self._known if record is not None and one.stands(record.epoch, record.recovery)]
        self._keep([*(one for one in there if one.id != left.id), left])

    def look(self) -> None:
        """Say it beside the gate where that tells otherwise. Called now and then while nothing is recovered; returns at once."""
        self._forget_past_ones()
        record = self._gate.record
        if record is None or (self._saying is not None and not self._saying.done()):
            return
        given_up = any(one.stands(record.epoch, record.recovery) for one in self._known)
        if self._is_left(record.recovery) or given_up:
            self._saying = asyncio.create_task(self._gate.end_recovery(record))

    def _is_left(self, text: str) -> bool:
        """Whether another monitor would have recorded it by now: the robot has been driven for so long by an instance that is healthy."""
        found, driven = self._gate.state.recovery, self._notices.status.health in ("Healthy", "Degraded")
        # Of a switchover it is seen what came of it (understudy.monitor.act.planned_switchover).
        if (
            found is None
            or found.switchover is not None
            or not under_way(Committed.of(found), self._notices.status.told)
        ):
            text = ""
        now = time.monotonic()
        if not driven or not text or self._left[0] != text:
            self._left = (text if driven else "", now)
            return False
        return now - self._left[1] >= LASTS

    @property
    def _known(self) -> list[GivenUp]:
        if self._kept is None:
            self._kept = self._journal.journal.given_up()
        return self._kept

    def _forget_past_ones(self) -> None:
        """Forget those of which the gate doesn't tell any more, and can't come to."""
        record = self._gate.record
        if record is None or not self._known:
            return
        found = beside(record.recovery)
        said = found.id if found is not None and found.result != "Running" else ""
        left = [
            one
            for one in self._known
            if one.id != said and (one.stands(record.epoch, record.recovery) or one.may_come(record.epoch))
        ]
        if left != self._known:
            self._keep(left)

    def _keep(self, given_up: list[GivenUp]) -> None:
        self._kept = given_up
        try:
            self._journal.journal.give_up(given_up)
        except OSError as error:
            _logger.error("what was given up would not outlast a restart: %s", error)
