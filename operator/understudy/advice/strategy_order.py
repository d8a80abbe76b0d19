"""From requirements to an order.

The rules, in full:

1. A strategy costs what its standbys take of a working instance's CPU. With resourceUsage Low those that cost more than next to nothing
   are left out. With safety or taskCriticality High it counts as High. A restart costs nothing, so it's never left out.
2. Of the rest, those go first of whose instances is known what ``safety`` asks for, if there are any.
3. The first strategy is the cheapest of these that recovers as soon as ``availability`` and ``taskCriticality`` ask for, whichever asks
   for more. If none does, or with resourceUsage High, it's the one that recovers soonest.
4. Behind it come those that cost next to nothing, with resourceUsage High all: as safety asks for, then the soonest first.

So whoever asks for more availability never gets a slower first strategy, since the cheapest of fewer that are fast enough is never
slower than the cheapest of more. Requirements that can't be met don't stop anything: what lacks is told.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from understudy.advice.strategy_figures import Figure, Figures, Way
from understudy.api.kinds.requirements_spec import Level, Requirements

SOON: Mapping[Level, float] = {"Low": math.inf, "Medium": 2.0, "High": 0.5}
"""Seconds from a failure's detection to its recovery. Medium: a short stop. High: as long as many bases go on by themselves after
their last command, so that they hardly stop.
"""

NEXT_TO_NOTHING = 0.1
"""What standbys may take, as a share of a working instance's CPU, that nobody minds: processes that only wait."""

_UP: Mapping[Way, int] = {"Executing": 0, "Initialized": 1, "Uninitialized": 2, "Restart": 2}
"""How far what takes over is from having been seen to be healthy. One that only has to start is as far as any other."""


@dataclass(frozen=True)
class Candidate:
    """A strategy that could be taken."""

    way: Way
    pool: str = ""
    standbys: float = 0.0
    """Instances that wait for one workload; of a shared pool its share of them."""


@dataclass(frozen=True)
class Judged:
    """A candidate, and what is expected of it."""

    candidate: Candidate
    seconds: Figure
    """From a failure's detection to its recovery."""
    cpu: Figure
    """Of one standby, as a share of a working instance's."""

    @property
    def cost(self) -> float:
        """What its standbys take, as a share of a working instance's CPU."""
        return self.candidate.standbys * self.cpu.value

    @property
    def speed(self) -> tuple[float, float, int, str]:
        """By which the soonest is least; never the same for two."""
        return self.seconds.value, self.cost, *self._name

    @property
    def thrift(self) -> tuple[float, float, int, str]:
        """By which the cheapest is least; never the same for two."""
        return self.cost, self.seconds.value, *self._name

    @property
    def _name(self) -> tuple[int, str]:
        return list(_UP).index(self.candidate.way), self.candidate.pool


@dataclass(frozen=True)
class Order:
    """Which strategies are tried, in which order, and what becomes of the others."""

    requirements: Requirements
    chosen: tuple[Judged, ...]
    """In order, and never empty."""
    costly: tuple[Judged, ...] = ()
    """Left out, since they cost more than next to nothing, and no more is allowed."""
    spared: tuple[Judged, ...] = ()
    """Left out, since behind the first one they aren't worth what they cost."""
    safe_commands: bool = True
    """Whether the robot is told something while no instance is in control."""

    @property
    def left_out(self) -> tuple[Judged, ...]:
        """All that aren't taken."""
        return (*self.costly, *self.spared)

    @property
    def first(self) -> Judged:
        """The one that is counted on."""
        return self.chosen[0]

    @property
    def soon_enough(self) -> bool:
        """Whether the first one recovers as soon as is asked for."""
        return self.first.seconds.value <= soon(self.requirements)

    @property
    def safe_enough(self) -> bool:
        """Whether of the first one is known what safety asks for."""
        return lacks(self.requirements, self.first.candidate.way) == 0


def soon(requirements: Requirements) -> float:
    """Seconds within which a failure is to be recovered from after its detection."""
    return min(SOON[requirements.availability], SOON[requirements.task_criticality])


def usage(requirements: Requirements) -> Level:
    """How much standbys may take: what is said of it counts less than a robot's safety and what would be lost."""
    if "High" in (requirements.safety, requirements.task_criticality):
        return "High"
    return requirements.resource_usage


def spent(requirements: Requirements) -> float:
    """The most that a strategy's standbys may take, as a share of a working instance's CPU."""
    return NEXT_TO_NOTHING if usage(requirements) == "Low" else math.inf


def lacks(requirements: Requirements, way: Way) -> int:
    """How far an instance is from what safety asks to be known of it; 0 where all is known."""
    allowed = {"High": 0, "Medium": 1, "Low": 2}[requirements.safety]
    return max(0, _UP[way] - allowed)


def ordered(
    requirements: Requirements, pools: Iterable[Candidate], figures: Figures, *, safe_commands: bool = True
) -> Order:
    """The order of a restart and of fallbacks from these pools."""
    candidates = {*pools, Candidate("Restart")}
    judged = [Judged(one, figures.seconds(one.way), figures.cpu(one.way)) for one in candidates]
    allowed = [one for one in judged if one.cost <= spent(requirements)]
    first = _first(requirements, allowed)
    most = math.inf if usage(requirements) == "High" else NEXT_TO_NOTHING
    behind = [one for one in allowed if one is not first and one.cost <= most]
    behind.sort(key=lambda one: (lacks(requirements, one.candidate.way), one.speed))
    chosen = (first, *behind)
    return Order(
        requirements,
        chosen,
        costly=tuple(sorted((one for one in judged if one not in allowed), key=lambda one: one.speed)),
        spared=tuple(sorted((one for one in allowed if one not in chosen), key=lambda one: one.speed)),
        safe_commands=safe_commands,
    )


def _first(requirements: Requirements, allowed: list[Judged]) -> Judged:
    least = min(lacks(requirements, one.candidate.way) for one in allowed)
    known = [one for one in allowed if lacks(requirements, one.candidate.way) == least]
    enough = [one for one in known if one.seconds.value <= soon(requirements)]
    if enough and usage(requirements) != "High":
        return min(enough, key=lambda one: one.thrift)
    return min(known, key=lambda one: one.speed)
