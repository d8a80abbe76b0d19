"""When the monitor evaluates: at deadlines, when a message comes that may be a failure by itself, and else at ticks.

It is woken at deadlines, not at the next tick: a 500 ms gap is noticed 500 ms after the last sample was received.
"""

from __future__ import annotations

import asyncio
import contextlib
import time

from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups

TICK = 0.1
"""Longest time between two evaluations, in seconds; what arrives in between waits in the middleware's queue."""

APART = 0.01
"""Least seconds between two evaluations for the sake of messages that come: a fast topic must not take the processor."""

WAKE_LATE = 0.0005
"""Seconds after a deadline at which the evaluation starts, so that the clock has surely passed it."""

STALLED = 0.03
"""Seconds late at which this process counts as having been stalled. Then what the middleware received meanwhile may not
be in its queues yet either, and silence is judged only after as long again."""

STALL_MOST = 0.25
"""Maximum seconds that a verdict waits because of a stall: a node that is starved for longer cannot be waited for."""


class Wakeups:
    """Ends the waits of the monitor's loops early. Anybody in the monitor may call these."""

    def __init__(self) -> None:
        self.evaluation = asyncio.Event()
        """Set to have the monitor's loop evaluate at once."""
        self.permits = asyncio.Event()
        """Set to have the permits of instances checked again at once."""

    def pod_changed(self) -> None:
        """Report that a pod of the workload changed."""
        self.evaluation.set()

    def dependency_changed(self) -> None:
        """Report that a workload that this one depends on has a new status or gate."""
        self.evaluation.set()

    def agent_reported(self) -> None:
        """Report that an agent sent its status, or that its connection began or ended."""
        self.evaluation.set()
        self.permits.set()


class EvaluationSchedule:
    """Starts one evaluation after the other. Times are Unix seconds."""

    def __init__(self, wakeups: Wakeups, arrivals: ArrivalWakeups | None) -> None:
        """``arrivals`` report messages that are evaluated when they arrive."""
        self._wake = wakeups.evaluation
        self.late = 0.0
        """By how many seconds the present evaluation is late."""
        self.trusted_from = 0.0
        """Silence counts from here on (Unix seconds)."""
        self.count = 0
        """Evaluations so far."""
        self.overruns = 0
        """Evaluations that were late by more than STALLED."""
        self._arrivals = arrivals
        self._started = 0.0
        self._next: float | None = None

    def restart(self) -> None:
        """Note that something else was done since the last evaluation: the next one is not late."""
        self._next = None

    def begin(self) -> float:
        """Start an evaluation. Returns its time in Unix seconds; it covers everything that has arrived until then."""
        self._wake.clear()
        if self._arrivals is not None and self._arrivals.asked:
            self._arrivals.clear()
        now = self._started = time.time()
        self.late = max(0.0, now - self._next) if self._next is not None else 0.0
        self.count += 1
        self.overruns += self.late > STALLED
        if self.late > STALLED:
            self.trusted_from = now + min(self.late, STALL_MOST)
        self.trusted_from = min(self.trusted_from, now + STALL_MOST)  # later where the clock was set back since
        return now

    async def until(self, moment: float) -> None:
        """Wait for the next evaluation: at this moment, or earlier if a message arrives or a wake-up is requested."""
        self._next = moment
        with contextlib.ExitStack() as stack:
            if self._arrivals is not None and self._arrivals.asked:
                self._listen(self._arrivals.descriptor, stack)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.0, moment - time.time())):
                    await self._wake.wait()

    def _listen(self, descriptor: int, stack: contextlib.ExitStack) -> None:
        loop = asyncio.get_running_loop()

        def arrived() -> None:
            loop.remove_reader(descriptor)  # until the next evaluation, which clears it
            rest = self._started + APART - time.time()
            if rest <= 0:
                self._wake.set()
            else:
                stack.callback(loop.call_later(rest, self._wake.set).cancel)

        loop.add_reader(descriptor, arrived)
        stack.callback(loop.remove_reader, descriptor)
