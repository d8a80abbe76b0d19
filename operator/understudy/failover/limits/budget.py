"""How many recoveries may begin in a window of time that moves on; pure. Times are unix seconds.

A recovery that is verified and soon followed by the next, again and again, helps nobody: it uses up the pools that others share, and
what is wrong needs a person.
"""

from __future__ import annotations

from collections.abc import Sequence


def left(spent: Sequence[float], now: float, *, recoveries: int, within: float) -> int:
    """How many may begin now, given when the others did."""
    return max(0, recoveries - sum(moment > now - within for moment in spent))


def free_from(spent: Sequence[float], *, recoveries: int, within: float) -> float:
    """When the next one may begin: a time that is over where it may now."""
    latest = sorted(spent)[-recoveries:]
    return latest[0] + within if len(latest) == recoveries else 0.0


def counted(spent: Sequence[float], resumed: float | None, now: float) -> list[float]:
    """Those that count: not what somebody has looked at since, who then said to go on.

    A word of the future is none. It would take all that is to come out of the count.
    """
    if resumed is None or resumed > now + CLOCKS_DIFFER:
        return list(spent)
    return [moment for moment in spent if moment > resumed]


CLOCKS_DIFFER = 60.0
"""Seconds that the clock of who says to go on may be ahead of the monitor's."""
