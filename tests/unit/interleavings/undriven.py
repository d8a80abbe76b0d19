"""What must hold of robots that nobody drives although an instance could."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tests.unit.interleavings.senses import GAP
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.kube.repeated_requests import RETRY_MOST, TRY_WITHIN
from understudy.monitor.judge.sole_driver import LISTEN, QUIET
from understudy.monitor.loop import SETTLE
from understudy.monitor.observe.objects.other_monitors import ANSWER_WITHIN, ASK_PERIOD


def longest(policy: FailurePolicySpec) -> float:
    """Return the seconds within which a working instance drives once nothing hinders its monitor any more, as after an API outage.

    The monitor notices the failure, and its request to the API server ends. It may wait until it knows that the monitor whose recovery is
    under way is gone, and for the agents, or until a leak has ended, and then each strategy has its time.
    """
    strategies = sum(seconds(strategy.verify_within) for strategy in policy.strategies)
    another, leak = ASK_PERIOD + ANSWER_WITHIN + SETTLE, LISTEN + QUIET
    request = TRY_WITHIN + RETRY_MOST
    return GAP + request + another + leak + seconds(policy.monitoring.startup_grace) + strategies


class Undriven:
    """No robot waits for longer."""

    def __init__(self, clock: Callable[[], float], broken: Callable[[str], None]) -> None:
        self._clock, self._broken = clock, broken
        self._since: dict[str, float] = {}
        """By robot, since when nobody drives it, an instance could, and nothing hinders its monitor."""

    def look(self, robot: str, able: Sequence[str], within: float) -> None:
        """``able`` are the instances that could drive a robot that nobody drives; empty if somebody does, or its monitor is hindered."""
        if not able:
            self._since.pop(robot, None)
            return
        lasts = self._clock() - self._since.setdefault(robot, self._clock())
        if lasts > within:
            self._broken(f"nobody drives {robot} for {lasts:.1f} s, and {' and '.join(able)} could")
