"""Determines which situation of the policy applies, with hysteresis: standbys are not deleted and created again between two tasks.

Pure: the caller passes the observations and the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from understudy.failover.degradation import Period


@dataclass(frozen=True)
class Rule:
    """When a situation applies. Times are seconds."""

    name: str
    after: float
    clear_after: float


class Situations:
    """The situations of a policy, of which one applies at a time. Times are seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._lasting: dict[str, Period] = {}

    def adopt(self, name: str, now: float) -> None:
        """Continue with a situation that applied before this process started."""
        self._lasting[name] = Period(now)

    def note(self, rules: Sequence[Rule], states: Mapping[str, bool | None], now: float) -> str | None:
        """Record for each situation whether it is observed (None if that is unknown), and return the first one that applies.

        Situations that are no longer in ``rules`` are dropped.
        """
        self._lasting = {rule.name: self._lasting.get(rule.name) or Period() for rule in rules}
        counting = [
            rule.name
            for rule in rules
            if self._lasting[rule.name].note(states.get(rule.name), now, after=rule.after, clear_after=rule.clear_after)
        ]
        return counting[0] if counting else None
