"""How often the same object may be put right again, where somebody else changes it back each time.

Two that both want the last word would write as fast as they hear of each other, for ever: another controller, or another installation of
Understudy. Who only sees one of them, such as a monitor that is restarted each time, can't tell why.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

AT_ONCE = 5
"""Repairs of an object that are made as soon as they are seen to be needed."""
EVERY = 30.0
"""Seconds to each further one."""

Place = tuple[str, str, str]
"""Plural, namespace and name."""


@dataclass
class _Repairs:
    stamp: str
    left: float
    at: float


class Contention:
    """What was written where, and how often it was written again."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._known: dict[Place, _Repairs] = {}

    def wait(self, place: Place, stamp: str) -> bool:
        """Whether what has that stamp was put right there so often that it should wait."""
        known = self._known.get(place)
        if known is None or known.stamp != stamp:
            return False
        return known.left + (self._clock() - known.at) / EVERY < 1

    def written(self, place: Place, stamp: str) -> None:
        """Remember a write that was carried out. Of what is written for the first time all repairs are left."""
        known, now = self._known.get(place), self._clock()
        if known is None or known.stamp != stamp:
            self._known[place] = _Repairs(stamp, AT_ONCE, now)
            return
        known.left = max(0.0, min(AT_ONCE, known.left + (now - known.at) / EVERY) - 1)
        known.at = now

    def forget(self, gone: Callable[[Place], bool]) -> None:
        """Forget objects that aren't there any more."""
        self._known = {place: known for place, known in self._known.items() if not gone(place)}
