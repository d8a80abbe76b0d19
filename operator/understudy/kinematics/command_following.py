"""Tests whether a robot that is observed from outside follows its commands.

There are two steps. *Which velocities are possible?* The commands give an interval of velocities for each moment: a command acts after a
delay of which only the upper bound is known, and the robot reaches the commanded velocity with at least some acceleration. *Is the observed
velocity outside this interval by more than chance?* A cumulative sum (CUSUM: E. S. Page, Continuous Inspection Schemes, Biometrika 41,
1954) of log-likelihood ratios tests that, one for each direction in which a velocity can be wrong.

The rate of false alarms is known in advance: by chance, a sum of log-likelihood ratios passes a threshold h at most once in exp(h)
independent observations (G. Lorden, Procedures for Reacting to a Change in Distribution, Annals of Mathematical Statistics 42, 1971).
Velocities over overlapping windows are not independent. So each one counts by the fraction of the window that has passed since the previous
one. By Hoelder's inequality, the observations of one window then weigh no more than one independent observation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

SILENT = 0.5
"""Seconds after the last command after which the robot may have stopped or may continue."""

LOST = 1.0
"""Seconds without an observation after which nothing can be determined."""

BETWEEN_FALSE_ALARMS = 10 * 365 * 86400.0
"""Seconds of driving in which at most one false alarm is expected."""

STEPS = 3
"""Minimum number of observations for a failure: a single wrong one may be a misread marker."""

JITTER = 0.015, 0.05
"""Standard deviations, in m/s and rad/s, of the velocity of a robot that works well: floors, wheels and controllers are uneven."""

MOST_PIECES = 1000
"""Maximum number of commands that are remembered: 50 Hz for twenty seconds."""

Component = Literal["forward", "sideways", "turning"]
COMPONENTS: tuple[Component, ...] = ("forward", "sideways", "turning")


class Motion(NamedTuple):
    """A commanded or observed velocity in the robot's own frame (REP 103): m/s forward and to the left, rad/s."""

    forward: float
    left: float
    turn: float


@dataclass(frozen=True)
class Allowance:
    """The tolerances between commands and observed motion. All are at least 0; accelerations are above 0."""

    delay: float = 0.3
    """Maximum seconds from a command to its visible effect: communication, control, camera and detection."""
    window: float = 0.5
    """Seconds over which the observed velocity is averaged."""
    acceleration: float = 0.5
    """Minimum acceleration in m/s2 with which the robot reaches a commanded velocity."""
    turn_acceleration: float = 1.0
    """rad/s2"""
    slip: float = 0.2
    """Fraction of a velocity that may be wrong."""
    tolerance: float = 0.03
    """Additional error in m/s that is allowed."""
    turn_tolerance: float = 0.1
    """rad/s"""

    @property
    def threshold(self) -> float:
        """The sum of log-likelihood ratios that counts as a failure. The bound on false alarms covers all tests together."""
        return math.log(BETWEEN_FALSE_ALARMS / max(self.window, 0.05) * 2 * len(COMPONENTS))


class _Piece(NamedTuple):
    """A value that is in force for some time."""

    value: float
    begin: float
    end: float


class Reach:
    """The velocities that a robot may have in one component, by its commands. Times are seconds of one clock."""

    def __init__(self, acceleration: float, slack: float) -> None:
        """``slack`` is the seconds for which a command may have an effect after its end, in addition to the time to change speed."""
        self._acceleration, self._slack = acceleration, slack
        self._pieces: deque[_Piece] = deque(maxlen=MOST_PIECES)
        self._value: float | None = None
        self._begin = self._last = 0.0

    def command(self, time: float, value: float) -> None:
        """Record a command. Times do not go back."""
        if self._value is not None:
            self._interrupt(time)
            if value != self._value:
                self._pieces.append(_Piece(self._value, self._begin, time))
                self._begin = time
        else:
            self._begin = time
        self._value, self._last = value, time

    def had(self, time: float, value: float) -> None:
        """Record an observed velocity whose cause is not known."""
        self._pieces.append(_Piece(value, time, time))

    def _interrupt(self, time: float) -> None:
        """Record that the robot may have stopped, if no command came for some time."""
        if time - self._last > SILENT:
            self._pieces.append(_Piece(0.0, self._last + SILENT, time))

    def bounds(self, time: float) -> tuple[float, float] | None:
        """Return the lowest and highest velocity that is possible within the window up to a time; None without a command."""
        if self._value is None:
            return None
        low = high = self._value
        if time - self._last > SILENT:
            low, high = min(low, 0.0), max(high, 0.0)
        kept: list[_Piece] = []
        for piece in reversed(self._pieces):  # newest first: a piece within the range of newer ones never widens it
            over = self._acceleration * max(0.0, time - piece.end - self._slack)
            if piece.value + over < low or piece.value - over > high or not over:
                kept.append(piece)
                low, high = min(low, piece.value + over), max(high, piece.value - over)
        if len(kept) < len(self._pieces):
            self._pieces = deque(reversed(kept), maxlen=MOST_PIECES)
        return low, high

    def shift(self, seconds: float) -> None:
        """Adjust all times after the clock was set by ``seconds``."""
        self._begin += seconds
        self._last += seconds
        self._pieces = deque(
            (_Piece(value, begin + seconds, end + seconds) for value, begin, end in self._pieces), maxlen=MOST_PIECES
        )


class Sums:
    """Page's two sums for one component: one for too slow, one for too fast."""

    def __init__(self, threshold: float, least: float) -> None:
        """``least`` is the discrepancy beyond the tolerance that is to be found soonest."""
        self._threshold, self._least = threshold, least
        self._below = self._above = 0.0
        self._since: float | None = None
        self.failed = False
        """Whether a sum has reached the threshold and the sums have not returned to 0 since."""

    @property
    def since(self) -> float | None:
        """Since when the velocity has been wrong according to the sums; None while it is right."""
        return self._since

    def add(self, time: float, measured: float, low: float, high: float, variance: float, part: float) -> None:
        """Add an observation. Velocities from ``low`` to ``high`` are allowed; ``part`` is its weight relative to an independent one."""
        most = self._threshold / STEPS
        scale = part * self._least / variance

        def summed(before: float, beyond: float) -> float:
            step = scale * (beyond - self._least / 2)
            # The sum stops at the threshold, so that it can fall as quickly as it rose.
            return min(self._threshold, max(0.0, before + min(most, max(-most, step))))

        self._below, self._above = summed(self._below, low - measured), summed(self._above, measured - high)
        largest = max(self._below, self._above)
        if not largest:
            self.failed, self._since = False, None
        else:
            self._since = self._since if self._since is not None else time
            self.failed = self.failed or largest >= self._threshold

    def shift(self, seconds: float) -> None:
        """Adjust all times after the clock was set by ``seconds``."""
        self._since = self._since + seconds if self._since is not None else None


@dataclass(frozen=True)
class Discrepancy:
    """A component in which a robot does not move as commanded."""

    component: Component
    measured: float
    low: float
    high: float
    """The observed velocity, and the bounds that the commands allow, in m/s or rad/s."""

    def __str__(self) -> str:
        unit = "rad/s" if self.component == "turning" else "m/s"
        low, high = f"{self.low:.2f}", f"{self.high:.2f}"
        commanded = low if low == high else f"{low} to {high}"
        return f"{self.component} {self.measured:.2f} {unit} observed, {commanded} {unit} commanded"


class CommandFollowing:
    """Compares commands with the observed motion. All times are seconds of one clock, the time of receipt of both."""

    def __init__(self, allowance: Allowance) -> None:
        self._allowance = allowance
        slack = allowance.delay + allowance.window
        linear, angular = allowance.acceleration, allowance.turn_acceleration
        self._reaches = [Reach(acceleration, slack) for acceleration in (linear, linear, angular)]
        self._found: Discrepancy | None = None
        self._begin_sums()
        self._last: float | None = None
        self._commanded = self._known = False
        self._well: float | None = None

    def command(self, time: float, motion: Motion) -> None:
        """Record a command."""
        self._commanded = True
        for reach, value in zip(self._reaches, motion, strict=True):
            reach.command(time, value)

    def see(self, time: float, motion: Motion, variances: Motion) -> None:
        """Record the observed motion of the robot, with its variances in m2/s2 and rad2/s2."""
        if self._last is not None and time - self._last > LOST:
            self._begin_sums()
        before, self._last = self._last, time
        if not self._commanded:
            self._well = time
            return
        if not self._known:
            # The robot may have moved before the first command, and its motion takes time to change.
            self._known = True
            for reach, value in zip(self._reaches, motion, strict=True):
                reach.had(time, value)
        part = min(1.0, (time - before) / max(self._allowance.window, 1e-9)) if before is not None else 0.0
        bounds = [bound for reach in self._reaches if (bound := reach.bounds(time)) is not None]
        speed = max(abs(value) for bound in bounds[:2] for value in bound)
        for index, (low, high) in enumerate(bounds):
            turning = index == 2
            largest = max(abs(low), abs(high)) if turning else speed
            tolerance = self._allowance.turn_tolerance if turning else self._allowance.tolerance
            slack = self._allowance.slip * largest + tolerance
            variance = variances[index] + JITTER[turning] ** 2
            self._sums[index].add(time, motion[index], low - slack, high + slack, variance, part)
        failed = [index for index, sums in enumerate(self._sums) if sums.failed]
        if not failed:
            self._found = None
            times = [sums.since for sums in self._sums if sums.since is not None]
            self._well = min(times, default=time)
        elif self._found is None:
            index = failed[0]
            self._found = Discrepancy(COMPONENTS[index], motion[index], *bounds[index])

    def _begin_sums(self) -> None:
        """Start new sums: after a long gap, earlier observations do not describe the present."""
        allowance = self._allowance
        tolerances = allowance.tolerance, allowance.tolerance, allowance.turn_tolerance
        self._sums = [Sums(allowance.threshold, 2 * tolerance) for tolerance in tolerances]
        self._found = None

    def discrepancy(self, time: float) -> Discrepancy | None:
        """Return the discrepancy at a time, as it was when it was found; None if there is none or it cannot be determined."""
        until = self.until
        return self._found if until is not None and time < until else None

    @property
    def until(self) -> float | None:
        """The time until which the observations count if no more arrive; None if there are none."""
        return self._last + LOST if self._last is not None else None

    @property
    def well(self) -> float | None:
        """When the robot was last observed to move as commanded; None if never."""
        return self._well

    @property
    def is_known(self) -> bool:
        """Whether both commands and the robot's motion have been observed."""
        return self._known

    def shift(self, seconds: float) -> None:
        """Adjust all times after the clock was set by ``seconds``."""
        for part in self._parts():
            part.shift(seconds)
        self._last = self._last + seconds if self._last is not None else None
        self._well = self._well + seconds if self._well is not None else None

    def _parts(self) -> Iterator[Reach | Sums]:
        yield from self._reaches
        yield from self._sums
