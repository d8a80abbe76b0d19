"""Schedules the monitor's evaluations: at deadlines, when a message arrives that may be a failure by itself, and else at ticks.

Deadlines do not wait for the next tick: a gap of 500 ms is noticed 500 ms after the last sample was received.
"""

from __future__ import annotations

import asyncio
import contextlib
import time

from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups

TICK = 0.1
"""Maximum seconds between two evaluations. Messages that arrive in between wait in the middleware's queue."""

APART = 0.01
"""Minimum seconds between two evaluations because of messages: a fast topic must not take all CPU time."""

WAKE_LATE = 0.0005
"""Seconds after a deadline at which the evaluation starts, so that the clock has certainly passed it."""

STALLED = 0.03
"""Minimum lateness of an evaluation, in seconds, that counts as a stall of this process. The middleware may have been stalled too, and
its queues may lack messages, so silence counts only after the same time again."""

STALL_MOST = 0.25
"""Maximum seconds that a verdict waits because of a stall, also if the node is starved for longer."""


class Wakeups:
    """Ends the waits of the monitor's loops early. Every part of the monitor may call its methods."""

    def __init__(self) -> None:
        self.evaluation = asyncio.Event()
        """If set, the monitor's loop evaluates at once."""
        self.permits = asyncio.Event()
        """If set, the permits of instances are checked at once."""

    def pod_changed(self) -> None:
        """Report that a pod of the workload changed."""
        self.evaluation.set()

    def dependency_changed(self) -> None:
        """Report that a workload that this one depends on has a new status or gate."""
        self.evaluation.set()

    def trees_read(self) -> None:
        """Report that the trees of a changed object were read, so that it can be followed."""
        self.evaluation.set()

    def agent_reported(self) -> None:
        """Report that an agent sent its status, or that its connection began or ended."""
        self.evaluation.set()
        self.permits.set()


class EvaluationSchedule:
    """Determines when each evaluation starts, and how late it is. Times are Unix seconds."""

    def __init__(self, wakeups: Wakeups, arrivals: ArrivalWakeups | None) -> None:
        """``arrivals`` report messages that are evaluated when they arrive."""
        self._wake = wakeups.evaluation
        self.late = 0.0
        """Lateness of the present evaluation, in seconds."""
        self.trusted_from = 0.0
        """Silence counts from this time on (Unix seconds)."""
        self.count = 0
        """Number of evaluations so far."""
        self.overruns = 0
        """Number of evaluations that were late by more than STALLED."""
        self._arrivals = arrivals
        self._started = self._begun = 0.0
        """When the present evaluation started: in Unix seconds, and by the monotonic clock."""
        self._due: float | None = None
        """When the next evaluation is due, by the monotonic clock."""

    def restart(self) -> None:
        """Note that other work was done since the last evaluation, so the next one does not count as late."""
        self._due = None

    def begin(self) -> float:
        """Start an evaluation. Returns its time in Unix seconds: the evaluation covers all messages up to that time."""
        self._wake.clear()
        if self._arrivals is not None and self._arrivals.asked:
            self._arrivals.clear()
        now, clock = time.time(), time.monotonic()
        self._started, self._begun = now, clock
        self.late = max(0.0, clock - self._due) if self._due is not None else 0.0
        self.count += 1
        self.overruns += self.late > STALLED
        if self.late > STALLED:
            self.trusted_from = now + min(self.late, STALL_MOST)
        self.trusted_from = min(self.trusted_from, now + STALL_MOST)  # a later time means that the clock was set back
        return now

    async def until(self, moment: float) -> None:
        """Wait for the next evaluation: at this moment, or earlier if a message arrives or a wake-up is requested."""
        due = self._due = self._begun + moment - self._started
        with contextlib.ExitStack() as stack:
            if self._arrivals is not None and self._arrivals.asked:
                self._listen(self._arrivals.descriptor, stack)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.0, due - time.monotonic())):
                    await self._wake.wait()

    def _listen(self, descriptor: int, stack: contextlib.ExitStack) -> None:
        loop = asyncio.get_running_loop()

        def arrived() -> None:
            loop.remove_reader(descriptor)  # the next evaluation clears the descriptor
            rest = self._begun + APART - time.monotonic()
            if rest <= 0:
                self._wake.set()
            else:
                stack.callback(loop.call_later(rest, self._wake.set).cancel)

        loop.add_reader(descriptor, arrived)
        stack.callback(loop.remove_reader, descriptor)
