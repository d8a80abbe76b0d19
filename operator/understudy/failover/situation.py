"""Which of a policy's situations the robot is in, with hysteresis: a task that ends and begins again has no standby taken down and made.

Pure; what is seen, and when, others say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from understudy.failover.degradation import Lasting


@dataclass(frozen=True)
class Rule:
    """When a situation counts. Times are seconds."""

    name: str
    after: float
    clear_after: float


class Situations:
    """All situations of a policy, of which one is in force at a time. Times are seconds by one clock that is never set."""

    def __init__(self) -> None:
        self._lasting: dict[str, Lasting] = {}

    def adopt(self, name: str, now: float) -> None:
        """Go on from a situation that was in force before this process began."""
        self._lasting[name] = Lasting(now)

    def note(self, rules: Sequence[Rule], seen: Mapping[str, bool | None], now: float) -> str | None:
        """Note of each situation whether the robot is seen in it, None where that can't be told; the first one that counts.

        What isn't among ``rules`` any more is forgotten.
        """
        self._lasting = {rule.name: self._lasting.get(rule.name) or Lasting() for rule in rules}
        counting = [
            rule.name
            for rule in rules
            if self._lasting[rule.name].note(seen.get(rule.name), now, after=rule.after, clear_after=rule.clear_after)
        ]
        return counting[0] if counting else None
