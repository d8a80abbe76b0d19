"""Clocks that a test moves, in place of the module ``time`` of a module under test, and the system's clock, which a test sets."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

_REAL = time.time


@dataclass
class Clock:
    """Both clocks of a process, at the same time."""

    now: float = 1000.0

    def time(self) -> float:
        """Return Unix seconds."""
        return self.now

    def monotonic(self) -> float:
        """Return the seconds of the clock that is never set."""
        return self.now


class MonotonicClock(Clock):
    """The clock that is never set; Unix time is the real one."""

    def time(self) -> float:
        """Return Unix seconds."""
        return time.time()


def set_clock(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    """Set the system's clock, as this process sees it, ``step`` seconds ahead of the real one. The monotonic clock goes on."""
    monkeypatch.setattr(time, "time", lambda: _REAL() + step)
