"""Gaps and rates of times of receipt or of sending. All times are in seconds and in order."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise


def worst_gap(times: Sequence[float], since: float) -> float:
    """Return the longest time between two successive times of which the later is after ``since``; 0 if there are none."""
    return max((b - a for a, b in pairwise(times) if b > since), default=0.0)


def least_count(times: Sequence[float], window: float, since: float) -> int | None:
    """Return the least count in any window that ends after ``since`` and not after the last time.

    None if the times do not reach back far enough for one such window.
    """
    if not times or times[-1] <= since:
        return None
    # A count is least just before the next time.
    ends = [end for end in times if end > since and end - window >= times[0]]
    return min((bisect_left(times, end) - bisect_right(times, end - window) for end in ends), default=None)


def most_count(times: Sequence[float], window: float, since: float) -> int | None:
    """Return the greatest count in any window that ends after ``since``; None if no time is after it."""
    ends = [end for end in times if end > since]
    return max((bisect_right(times, end) - bisect_right(times, end - window) for end in ends), default=None)


def falls_below(times: Sequence[float], least: int, window: float, since: float) -> float | None:
    """Return when a window that ends after ``since`` first has fewer than ``least`` times, after it had that many; None
    for never.

    No time follows the last one. A window contains its end, but not its beginning.
    """
    for index in range(least - 1, len(times)):
        moment = times[index - least + 1] + window
        following = times[index + 1] if index + 1 < len(times) else None
        if moment > max(since, times[index]) and (following is None or moment < following):
            return moment
    return None


def first_from(times: Sequence[float], moment: float) -> float | None:
    """Return the first time that is not before a moment; None if there is none."""
    place = bisect_left(times, moment)
    return times[place] if place < len(times) else None
