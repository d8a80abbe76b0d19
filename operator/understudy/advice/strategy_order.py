"""Chooses the order of strategies from requirements.

The rules:

1. The cost of a strategy is the CPU of its standbys, as a share of a working instance's. With resourceUsage Low, strategies that cost
   more than a negligible share are left out. With safety or taskCriticality High, resourceUsage counts as High. A restart costs
   nothing and is never left out.
2. Strategies whose instances meet ``safety`` go first, if there are any.
3. The first strategy is the cheapest of these that is as fast as ``availability`` and ``taskCriticality`` require. If none is, or with
   resourceUsage High, it is the fastest one.
4. After it come those with negligible cost, or all with resourceUsage High: by safety, then the fastest first.

A higher availability therefore never leads to a slower first strategy. Requirements that cannot be met do not prevent an order;
they are reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from understudy.advice.strategy_figures import Figure, Figures, Way
from understudy.api.kinds.fallback_pool import LEVELS, ReadinessLevel
from understudy.api.kinds.requirements_spec import Level, Requirements

SOON: Mapping[Level, float] = {"Low": math.inf, "Medium": 2.0, "High": 0.5}
"""Seconds from detection to recovery. Medium: a short stop. High: about as long as many mobile bases continue after their last
command, so that they hardly stop.
"""

NEGLIGIBLE = 0.1
"""Negligible CPU of standbys, as a share of a working instance's: processes that only wait."""


def _doubt(level: ReadinessLevel) -> int:
    if level.runs_in_full:
        return 0
    return 1 if level.has_standbys else 2


_DOUBT: Mapping[Way, int] = {**{name: _doubt(level) for name, level in reversed(LEVELS.items())}, "Restart": 2}
"""How doubtful it is that the new instance is healthy: 0 means that it was observed to be healthy. The most prepared comes first."""


@dataclass(frozen=True)
class Candidate:
    """A possible strategy."""

    way: Way
    pool: str = ""
    standbys: float = 0.0
    """Waiting instances per workload; for a shared pool, the workload's share."""


@dataclass(frozen=True)
class RatedStrategy:
    """A candidate with its expected time and CPU."""

    candidate: Candidate
    seconds: Figure
    """From a failure's detection to its recovery."""
    cpu: Figure
    """CPU of one standby, as a share of a working instance's."""

    @property
    def cost(self) -> float:
        """CPU of its standbys, as a share of a working instance's."""
        return self.candidate.standbys * self.cpu.value

    @property
    def speed(self) -> tuple[float, float, int, str]:
        """Sort key for the fastest; unique."""
        return self.seconds.value, self.cost, *self._name

    @property
    def thrift(self) -> tuple[float, float, int, str]:
        """Sort key for the cheapest; unique."""
        return self.cost, self.seconds.value, *self._name

    @property
    def _name(self) -> tuple[int, str]:
        return list(_DOUBT).index(self.candidate.way), self.candidate.pool


@dataclass(frozen=True)
class Order:
    """The strategies in order, and those left out."""

    requirements: Requirements
    chosen: tuple[RatedStrategy, ...]
    """In order; never empty."""
    costly: tuple[RatedStrategy, ...] = ()
    """Left out because they cost more than the requirements allow."""
    spared: tuple[RatedStrategy, ...] = ()
    """Left out because they are not worth their cost after the first one."""
    safe_commands: bool = True
    """Whether the policy defines safe commands while no instance is active."""

    @property
    def left_out(self) -> tuple[RatedStrategy, ...]:
        """All strategies that were left out."""
        return (*self.costly, *self.spared)

    @property
    def first(self) -> RatedStrategy:
        """The first strategy."""
        return self.chosen[0]

    @property
    def is_fast_enough(self) -> bool:
        """Whether the first strategy is as fast as required."""
        return self.first.seconds.value <= required_time(self.requirements)

    @property
    def is_safe_enough(self) -> bool:
        """Whether the first strategy meets the safety requirement."""
        return safety_gap(self.requirements, self.first.candidate.way) == 0


def required_time(requirements: Requirements) -> float:
    """Return the required seconds from detection to recovery."""
    return min(SOON[requirements.availability], SOON[requirements.task_criticality])


def effective_resource_usage(requirements: Requirements) -> Level:
    """Return the effective resourceUsage: safety and taskCriticality High override it."""
    if "High" in (requirements.safety, requirements.task_criticality):
        return "High"
    return requirements.resource_usage


def most_cost(requirements: Requirements) -> float:
    """Return the most CPU of a strategy's standbys, as a share of a working instance's."""
    return NEGLIGIBLE if effective_resource_usage(requirements) == "Low" else math.inf


def safety_gap(requirements: Requirements, way: Way) -> int:
    """Return how far a strategy is from the safety requirement; 0 if it meets it."""
    allowed = {"High": 0, "Medium": 1, "Low": 2}[requirements.safety]
    return max(0, _DOUBT[way] - allowed)


def order_strategies(
    requirements: Requirements, pools: Iterable[Candidate], figures: Figures, *, safe_commands: bool = True
) -> Order:
    """Return the order of a restart and of fallbacks from these pools."""
    candidates = {*pools, Candidate("Restart")}
    judged = [RatedStrategy(one, figures.seconds(one.way), figures.cpu(one.way)) for one in candidates]
    allowed = [one for one in judged if one.cost <= most_cost(requirements)]
    first = _first(requirements, allowed)
    most = math.inf if effective_resource_usage(requirements) == "High" else NEGLIGIBLE
    behind = [one for one in allowed if one is not first and one.cost <= most]
    behind.sort(key=lambda one: (safety_gap(requirements, one.candidate.way), one.speed))
    chosen = (first, *behind)
    return Order(
        requirements,
        chosen,
        costly=tuple(sorted((one for one in judged if one not in allowed), key=lambda one: one.speed)),
        spared=tuple(sorted((one for one in allowed if one not in chosen), key=lambda one: one.speed)),
        safe_commands=safe_commands,
    )


def _first(requirements: Requirements, allowed: list[RatedStrategy]) -> RatedStrategy:
    least = min(safety_gap(requirements, one.candidate.way) for one in allowed)
    known = [one for one in allowed if safety_gap(requirements, one.candidate.way) == least]
    enough = [one for one in known if one.seconds.value <= required_time(requirements)]
    if enough and effective_resource_usage(requirements) != "High":
        return min(enough, key=lambda one: one.thrift)
    return min(known, key=lambda one: one.speed)
