"""What times of receipt, or of sending, say of gaps and rates. All times are in seconds and in order."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise


def worst_gap(times: Sequence[float], since: float) -> float:
    """The longest time between two that follow each other, of which the later is after ``since``; 0 if there are none."""
    return max((b - a for a, b in pairwise(times) if b > since), default=0.0)


def least_count(times: Sequence[float], window: float, since: float) -> int | None:
    """The least number of them in any window that ends after ``since``, and not after the last of them.

    None where they don't reach back far enough for one such window.
    """
    if not times or times[-1] <= since:
        return None
    # A count is least just before another one comes.
    ends = [end for end in times if end > since and end - window >= times[0]]
    return min((bisect_left(times, end) - bisect_right(times, end - window) for end in ends), default=None)


def most_count(times: Sequence[float], window: float, since: float) -> int | None:
    """The greatest number of them in any window that ends after ``since``; None where none of them is."""
    ends = [end for end in times if end > since]
    return max((bisect_right(times, end) - bisect_right(times, end - window) for end in ends), default=None)


def falls_below(times: Sequence[float], least: int, window: float, since: float) -> float | None:
    """When a window after ``since`` first has fewer than ``least`` of them, where it had as many before; None for never.

    Nothing follows the last of them.
    A window of this length that ends at a time has those after its beginning, and those at its end.
    """
    for index in range(least - 1, len(times)):
        moment = times[index - least + 1] + window
        following = times[index + 1] if index + 1 < len(times) else None
        if moment > max(since, times[index]) and (following is None or moment < following):
            return moment
    return None


def first_from(times: Sequence[float], moment: float) -> float | None:
    """The first of them that isn't before a moment; None if there is none."""
    place = bisect_left(times, moment)
    return times[place] if place < len(times) else None
