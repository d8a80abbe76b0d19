"""How long strategies take and what their standbys cost: as measured where it was, and else as published."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.kinds.robot_workload import Recovery

Way = Literal[Readiness, "Restart"]
"""What takes over: a standby of a readiness, or a pod that is started."""

LEAST = 3
"""Recoveries by a strategy from which on their times count: one that took long for once changes no order."""


@dataclass(frozen=True)
class Figure:
    """A figure and where it is from."""

    value: float
    source: str = "published"
    """Where it is from, in words."""


PUBLISHED_SECONDS: Mapping[Way, float] = {
    "Executing": 0.05,
    "Initialized": 0.83,
    "Uninitialized": 3.96,
    "Restart": 4.67,
}
"""From the detection of a failure to the recovery: means of this project's navigation stack (bench/results/navigation.json, the
table in examples/navigation/README.md without t_detection, which no strategy changes). Of its two initialized standbys the slower.

The paper tells fewer: 100 ms for a patch against 2.9 s for a restart on the cluster's part, 6 s in all for an uninitialized
fallback, and ten times less down-time in full execution than with a restart. They come in the same order.
"""

PUBLISHED_CPU: Mapping[Way, float] = {"Executing": 0.96, "Initialized": 0.68, "Uninitialized": 0.0, "Restart": 0.0}
"""What a waiting instance uses of what a working one does, from the same runs. The paper has 1 in full execution and 0.6 for one
that waits uninitialized, whose processes run there; here they are held before they start.
"""


@dataclass(frozen=True)
class Figures:
    """What is known; what isn't measured is as published."""

    measured_seconds: Mapping[Way, Figure] = field(default_factory=dict)
    measured_cpu: Mapping[Way, Figure] = field(default_factory=dict)

    def seconds(self, way: Way) -> Figure:
        """From a failure's detection to its recovery."""
        return self.measured_seconds.get(way) or Figure(PUBLISHED_SECONDS[way])

    def cpu(self, way: Way) -> Figure:
        """What one waiting instance uses of what a working one does."""
        return self.measured_cpu.get(way) or Figure(PUBLISHED_CPU[way])


def seen(recoveries: Iterable[Recovery]) -> dict[Way, Figure]:
    """What recorded recoveries say: for each strategy with :data:`LEAST` of them the median of all that comes after the detection.

    Left out are those that failed, that were planned, that another monitor had begun, in which another strategy was tried in vain
    before, and the reflex's, which is a way of its own.
    """
    taken: dict[Way, list[float]] = {}
    for one in recoveries:
        if one.result != "Recovered" or one.planned or one.resumed or one.parts is None:
            continue
        if any(attempt.result == "NotVerified" for attempt in one.attempts):
            continue
        for way in get_args(Readiness):
            if one.strategy == f"Fallback/{way}":
                taken.setdefault(way, []).append(_after_detection(one))
        if one.strategy == "Restart":
            taken.setdefault("Restart", []).append(_after_detection(one))
    return {
        way: Figure(statistics.median(values), f"measured {len(values)} times")
        for way, values in taken.items()
        if len(values) >= LEAST
    }


def _after_detection(recovery: Recovery) -> float:
    parts = recovery.parts
    assert parts is not None
    return parts.cluster + parts.startup + parts.reinitialization
