"""Whether a robot that is seen from outside does what it is commanded to.

Two questions, one after the other. *What may it do?* From the commands follows, for each moment, an interval of velocities:
a command acts after a delay that is only known not to be longer than some time, and what it asks for is reached
at some acceleration at least. *Is what is seen outside of that by more than chance?* That is asked by a cumulative sum
(CUSUM: E. S. Page, Continuous Inspection Schemes, Biometrika 41, 1954) of log-likelihood ratios, one for each direction in
which a velocity can be wrong.

How seldom it errs is known without trying: a sum of log-likelihood ratios passes a threshold h by chance once in exp(h)
independent observations or less (G. Lorden, Procedures for Reacting to a Change in Distribution, Annals of Mathematical Statistics
42, 1971). Velocities over a window are not independent of each other; each counts by the part of the window that passed since
the one before, and by Hoelder's inequality so many of them weigh no more than one that is independent.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

SILENT = 0.5
"""Seconds after a command from which on a robot may stop, since it is not commanded any more, or may go on."""

LOST = 1.0
"""Seconds without an observation after which nothing can be determined."""

BETWEEN_FALSE_ALARMS = 10 * 365 * 86400.0
"""Seconds of driving in which one false alarm is expected at most."""

STEPS = 3
"""How many observations a failure takes at least: a single one, however wrong, may be a marker that was misread."""

JITTER = 0.015, 0.05
"""Standard deviations, in m/s and rad/s, of the velocity of a robot that works well: floors, wheels and controllers are uneven."""

MOST_PIECES = 1000
"""Commands that are remembered at once; 50 Hz for twenty seconds."""

Component = Literal["forward", "sideways", "turning"]
COMPONENTS: tuple[Component, ...] = ("forward", "sideways", "turning")


class Motion(NamedTuple):
    """A velocity in the robot's own frame (REP 103), commanded or seen: m/s forward and to the left, rad/s."""

    forward: float
    left: float
    turn: float


@dataclass(frozen=True)
class Allowance:
    """What is allowed for between a command and what is seen. All are at least 0, accelerations more."""

    delay: float = 0.3
    """Seconds from a command to when its effect can be seen, at most: communication, control, camera and detection."""
    window: float = 0.5
    """Seconds over which what is seen is averaged."""
    acceleration: float = 0.5
    """m/s2 with which it reaches what is commanded, at least."""
    turn_acceleration: float = 1.0
    """rad/s2"""
    slip: float = 0.2
    """The part of a velocity that may be wrong."""
    tolerance: float = 0.03
    """m/s that may be wrong in addition."""
    turn_tolerance: float = 0.1
    """rad/s"""

    @property
    def threshold(self) -> float:
        """Which sum of log-likelihood ratios is a failure: the false alarms are those of all tests together."""
        return math.log(BETWEEN_FALSE_ALARMS / max(self.window, 0.05) * 2 * len(COMPONENTS))


class _Piece(NamedTuple):
    """A value that is in force for some time."""

    value: float
    begin: float
    end: float


class Reach:
    """The velocities that a robot may have in one component, by its commands. Times are seconds of one clock."""

    def __init__(self, acceleration: float, slack: float) -> None:
        """``slack`` is how many seconds a command may still show after its end, besides what slowing down takes."""
        self._acceleration, self._slack = acceleration, slack
        self._pieces: deque[_Piece] = deque(maxlen=MOST_PIECES)
        self._value: float | None = None
        self._begin = self._last = 0.0

    def command(self, time: float, value: float) -> None:
        """A command came. Times do not go back."""
        if self._value is not None:
            self._interrupt(time)
            if value != self._value:
                self._pieces.append(_Piece(self._value, self._begin, time))
                self._begin = time
        else:
            self._begin = time
        self._value, self._last = value, time

    def had(self, time: float, value: float) -> None:
        """It was seen to have this velocity, for reasons that are not known."""
        self._pieces.append(_Piece(value, time, time))

    def _interrupt(self, time: float) -> None:
        """Where nothing came for some time it may have stopped meanwhile, unless it went on."""
        if time - self._last > SILENT:
            self._pieces.append(_Piece(0.0, self._last + SILENT, time))

    def bounds(self, time: float) -> tuple[float, float] | None:
        """The least and the greatest velocity that it may have had within the window up to a time; None without a command."""
        if self._value is None:
            return None
        low = high = self._value
        if time - self._last > SILENT:
            low, high = min(low, 0.0), max(high, 0.0)
        kept: list[_Piece] = []
        for piece in reversed(self._pieces):  # newer ones first: what they cover the older do not widen, now or ever
            over = self._acceleration * max(0.0, time - piece.end - self._slack)
            if piece.value + over < low or piece.value - over > high or not over:
                kept.append(piece)
                low, high = min(low, piece.value + over), max(high, piece.value - over)
        if len(kept) < len(self._pieces):
            self._pieces = deque(reversed(kept), maxlen=MOST_PIECES)
        return low, high

    def shift(self, seconds: float) -> None:
        """The clock was set."""
        self._begin += seconds
        self._last += seconds
        self._pieces = deque(
            (_Piece(value, begin + seconds, end + seconds) for value, begin, end in self._pieces), maxlen=MOST_PIECES
        )


class Sums:
    """Page's two sums over one component: that it is too slow, and that it is too fast."""

    def __init__(self, threshold: float, least: float) -> None:
        """``least`` is the discrepancy, beyond what is allowed, that is to be found soonest."""
        self._threshold, self._least = threshold, least
        self._below = self._above = 0.0
        self._since: float | None = None
        self.failed = False
        """Whether a sum has reached the threshold, and none has come back to 0 since."""

    @property
    def since(self) -> float | None:
        """Since when it has been wrong, in the tests' view; None while it is right."""
        return self._since

    def add(self, time: float, seen: float, low: float, high: float, variance: float, part: float) -> None:
        """An observation: allowed is what lies between low and high. It counts by a ``part`` of an independent one."""
        most = self._threshold / STEPS
        scale = part * self._least / variance

        def summed(before: float, beyond: float) -> float:
            step = scale * (beyond - self._least / 2)
            # At the threshold a sum has said all; it is to come down as soon as it went up.
            return min(self._threshold, max(0.0, before + min(most, max(-most, step))))

        self._below, self._above = summed(self._below, low - seen), summed(self._above, seen - high)
        largest = max(self._below, self._above)
        if not largest:
            self.failed, self._since = False, None
        else:
            self._since = self._since if self._since is not None else time
            self.failed = self.failed or largest >= self._threshold

    def shift(self, seconds: float) -> None:
        """The clock was set."""
        self._since = self._since + seconds if self._since is not None else None


@dataclass(frozen=True)
class Discrepancy:
    """What is wrong with a robot's motion."""

    component: Component
    seen: float
    low: float
    high: float
    """What was seen, and what the commands let it be; m/s or rad/s."""

    def __str__(self) -> str:
        unit = "rad/s" if self.component == "turning" else "m/s"
        low, high = f"{self.low:.2f}", f"{self.high:.2f}"
        commanded = low if low == high else f"{low} to {high}"
        return f"{self.component} {self.seen:.2f} {unit} observed, {commanded} {unit} commanded"


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
        """A command came."""
        self._commanded = True
        for reach, value in zip(self._reaches, motion, strict=True):
            reach.command(time, value)

    def see(self, time: float, motion: Motion, variances: Motion) -> None:
        """The robot was seen to move so, with an uncertainty as variances in m2/s2 and rad2/s2."""
        if self._last is not None and time - self._last > LOST:
            self._begin_sums()
        before, self._last = self._last, time
        if not self._commanded:
            self._well = time
            return
        if not self._known:
            # It moved somehow before the first command, and that takes time to change.
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
        """From nothing: what was not seen for long says nothing of now."""
        allowance = self._allowance
        tolerances = allowance.tolerance, allowance.tolerance, allowance.turn_tolerance
        self._sums = [Sums(allowance.threshold, 2 * tolerance) for tolerance in tolerances]
        self._found = None

    def discrepancy(self, time: float) -> Discrepancy | None:
        """What is wrong at a time, as it was when it was found; None if nothing is, or it cannot be determined."""
        until = self.until
        return self._found if until is not None and time < until else None

    @property
    def until(self) -> float | None:
        """Until when what was seen says something, if nothing more is; None if nothing was seen."""
        return self._last + LOST if self._last is not None else None

    @property
    def well(self) -> float | None:
        """When it last moved as commanded, as far as was seen; None for never."""
        return self._well

    @property
    def is_known(self) -> bool:
        """Whether both commands and the robot have been seen."""
        return self._known

    def shift(self, seconds: float) -> None:
        """The clock was set by so many seconds."""
        for part in self._parts():
            part.shift(seconds)
        self._last = self._last + seconds if self._last is not None else None
        self._well = self._well + seconds if self._well is not None else None

    def _parts(self) -> Iterator[Reach | Sums]:
        yield from self._reaches
        yield from self._sums
