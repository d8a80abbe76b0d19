"""Limits how often the operator repairs an object that another client changes back each time.

Without a limit, the two writers would overwrite each other forever, as fast as they observe each other's changes. The
other writer can be another controller, or another installation of Understudy. A process that sees only one of them,
such as a monitor that is restarted each time, cannot find the cause.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

AT_ONCE = 5
"""Repairs of an object that are made immediately."""
EVERY = 30.0
"""Seconds between further repairs."""

Place = tuple[str, str, str]
"""Plural, namespace and name."""


@dataclass
class _Repairs:
    stamp: str
    left: float
    at: float


class RepairCounts:
    """Counts the repairs of each object."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._known: dict[Place, _Repairs] = {}

    def wait(self, place: Place, stamp: str) -> bool:
        """Whether the object with this stamp was repaired so often that the next repair should wait."""
        known = self._known.get(place)
        if known is None or known.stamp != stamp:
            return False
        return known.left + (self._clock() - known.at) / EVERY < 1

    def written(self, place: Place, stamp: str) -> None:
        """Record a write that succeeded. The first write of a stamp does not count as a repair."""
        known, now = self._known.get(place), self._clock()
        if known is None or known.stamp != stamp:
            self._known[place] = _Repairs(stamp, AT_ONCE, now)
            return
        known.left = max(0.0, min(AT_ONCE, known.left + (now - known.at) / EVERY) - 1)
        known.at = now

    def forget(self, gone: Callable[[Place], bool]) -> None:
        """Forget the objects for which ``gone`` returns true."""
        self._known = {place: known for place, known in self._known.items() if not gone(place)}
