"""A workload whose policy says what well means, and a clock that the test moves."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.support.clock import MonotonicClock
from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.senses import GivenObserver
from understudy.api.conditions import condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.interfaces import Instance
from understudy.monitor.judge import degradation_level
from understudy.monitor.judge.degradation_level import DegradationLevel
from understudy.monitor.notices import PublishedStatus
from understudy.trees.core.health_tree import Verdict

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
OTHER = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True)
HEALTHY = Verdict("Healthy", "", "", None)
FAILED = Verdict("Failed", "no /scan for 1 s", "scan", None)
SLOW = Verdict("Failed", "/scan at 8.6 Hz, below 9 Hz over 2 s", "sensors/scan", None)
UNKNOWN = Verdict("Starting", "/scan is starting", "sensors/scan", None)
WELL = {"yaml": {"topic": {"name": "/scan", "rate": "> 9 Hz"}}, "debounce": "2s"}
RESCHEDULE = {"after": "5s", "idleFor": "3s", "pause": "1m"}
HAND_OVER = {"monitoring": WELL, "clearAfter": "10s", "actions": [{"reschedule": RESCHEDULE}]}


def policy(degraded: dict[str, Any] | None = None, *strategies: dict[str, Any], **more: Any) -> FailurePolicySpec:
    """Return a policy with this in ``spec.degraded``."""
    health = {"yaml": {"topic": {"name": "/scan", "gap": "1s"}}}
    return policy_of(*strategies, monitoring=health, degraded=degraded, **more)


TIGHT = policy({"monitoring": WELL, "clearAfter": "5s"})
HANDED = policy(HAND_OVER)


class World:
    """The level of one workload. What the tree of spec.degraded says stands in the observer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.observer = MonotonicClock(), GivenObserver()
        monkeypatch.setattr(degradation_level, "time", self.clock)
        self.observer.well = HEALTHY
        self.notices = RecordedNotices()
        self.levels = DegradationLevel(self.observer, self.notices)

    def adopt(self, active: str) -> None:
        """Begin as a monitor whose predecessor reported this instance as active and degraded."""
        degraded = condition("Degraded", True, "NotWell", "/scan at 8.6 Hz.")
        self.notices = RecordedNotices(PublishedStatus(by_type={"Degraded": degraded}, adopted=active))
        self.levels = DegradationLevel(self.observer, self.notices)

    def look(
        self,
        seconds: float,
        *,
        policy: FailurePolicySpec = TIGHT,
        health: Verdict = HEALTHY,
        active: Instance = ACTIVE,
    ) -> bool:
        """Look ten times a second for so long; whether it is degraded at the end."""
        degraded = False
        for _ in range(round(seconds * 10)):
            self.clock.now += 0.1
            degraded = self.levels.evaluate(policy, health, active, now=time.time(), since=0.0)
        return degraded

    @property
    def condition(self) -> tuple[str, str]:
        """Status and reason of the condition."""
        return self.notices.conditions["Degraded"][:2]
