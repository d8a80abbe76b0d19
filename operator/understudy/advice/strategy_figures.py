"""Recovery times of strategies and CPU of their standbys: measured if available, otherwise published."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.kinds.robot_workload import Recovery

Way = Literal[Readiness, "Restart"]
"""What takes over: a standby with a readiness, or a restarted pod."""

LEAST = 3
"""Least number of recoveries for a measurement, so that a single slow recovery does not change the order."""


PUBLISHED = "published"
"""Source of a figure that was not measured for the workload."""


@dataclass(frozen=True)
class Figure:
    """A figure and its source."""

    value: float
    source: str = PUBLISHED
    """The source, in words."""


PUBLISHED_SECONDS: Mapping[Way, float] = {
    "Executing": 0.05,
    "Initialized": 0.83,
    "Uninitialized": 3.96,
    "Restart": 4.67,
}
"""Seconds from detection to recovery: means of this project's navigation stack (bench/results/navigation.json, and the table in
examples/navigation/README.md without t_detection, which is independent of the strategy). The slower of two initialized standbys.

The paper gives fewer figures: 100 ms for a patch and 2.9 s for a restart (cluster part), 6 s in total for an uninitialized
fallback, and ten times less downtime in full execution than with a restart. The order is the same.
"""

PUBLISHED_CPU: Mapping[Way, float] = {"Executing": 0.96, "Initialized": 0.68, "Uninitialized": 0.0, "Restart": 0.0}
"""CPU of a waiting instance as a share of a working one's, from the same runs. The paper has 1 in full execution and 0.6 for an
uninitialized one, whose processes run there; here they are held before they start.
"""


@dataclass(frozen=True)
class Figures:
    """Measured figures, with published ones as a fallback."""

    measured_seconds: Mapping[Way, Figure] = field(default_factory=dict)
    measured_cpu: Mapping[Way, Figure] = field(default_factory=dict)

    def seconds(self, way: Way) -> Figure:
        """Return the seconds from detection to recovery."""
        return self.measured_seconds.get(way) or Figure(PUBLISHED_SECONDS[way])

    def cpu(self, way: Way) -> Figure:
        """Return the CPU of a waiting instance as a share of a working one's."""
        return self.measured_cpu.get(way) or Figure(PUBLISHED_CPU[way])


def measured_times(recoveries: Iterable[Recovery]) -> dict[Way, Figure]:
    """Return the median time after detection by strategy, from at least :data:`LEAST` recorded recoveries each.

    Failed, planned and resumed recoveries, recoveries after a failed attempt, and reflex recoveries do not count.
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
