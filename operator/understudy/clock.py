"""The clock of this process, and the conversion of its times to those of records and of other machines.

The rule: durations, and the order of moments, are measured by this clock. It counts Unix seconds with the monotonic clock, so they stay
the same if somebody sets the system's clock, as NTP does after the start of a machine. A time of the system's clock is converted once, when
it comes in: a receive time, a record next to a gate, a report of an agent. A time of this clock is converted once, when it is written: by
the system's clock as it is set at that moment, so that all moments of a record are of the same clock.

What judges samples (understudy.ros.observe, understudy.state, and the trees) follows the system's clock instead: it moves its times by
:meth:`ProcessClock.step`. A recovery is of this clock from its begin to its record.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

_BOOT = Path("/proc/sys/kernel/random/boot_id")

LEAST_STEP = 0.005
"""Minimum change in seconds between the system's clock and the monotonic clock that shows that the system's clock was set."""


class ProcessClock:
    """Unix seconds that no step of the system's clock changes. A process has one: CLOCK."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Take the system's clock as it is set now."""
        self._begun = self._known = _offset()

    def now(self) -> float:
        """Return the time. It equals that of the system's clock if nobody set that since the process started."""
        return time.monotonic() + self._begun

    def step(self) -> float:
        """Return by how many seconds the system's clock was set since the process started; exactly 0 if nobody set it."""
        offset = _offset()
        if abs(offset - self._known) >= LEAST_STEP:
            is_as_at_begin = abs(offset - self._begun) < LEAST_STEP
            self._known = self._begun if is_as_at_begin else offset
        return self._known - self._begun

    def to_system(self, moment: float) -> float:
        """Return a time of this clock as one of the system's clock, for a record or for another machine."""
        return moment + self.step()

    def of_system(self, moment: float) -> float:
        """Return a time of the system's clock, as it is set now, as one of this clock."""
        return moment - self.step()


def boot_id() -> str:
    """Return what identifies the present boot of this node; empty if that is not known."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""


def _offset() -> float:
    """Return the system's clock minus the monotonic clock, which changes when the former is set.

    A busy node may delay a reading, so the best of several counts.
    """
    best, offset = math.inf, 0.0
    for _ in range(5):
        before, now, after = time.monotonic(), time.time(), time.monotonic()
        if after - before < best:
            best, offset = after - before, now - (before + after) / 2
        if best < LEAST_STEP / 10:
            break
    return offset


CLOCK = ProcessClock()


class ClockSteps:
    """The steps of the system's clock, for records that follow it."""

    def __init__(self) -> None:
        self._known = CLOCK.step()

    def taken(self) -> float:
        """Return by how many seconds the clock was set since the last call, or since this object was made."""
        known = CLOCK.step()
        step, self._known = known - self._known, known
        return step
