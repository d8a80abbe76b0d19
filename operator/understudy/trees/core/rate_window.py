"""The arithmetic of rate windows.

The rate of a topic at a time is the number of samples received in the window that ends then, divided by the window's
length. Time is used in one expression only, ``arrival + window``, the time at which a sample leaves the window. The
time computed in advance is therefore exactly the time at which the count changes.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

HIGHEST = 10_000
"""The highest bound in Hz. ROS topics stay far below, and a window must fit into memory."""

_NUMBER = r"([0-9]+(?:\.[0-9]+)?)"
_BOUND = re.compile(rf"(>=|>|<=|<)\s*{_NUMBER}\s*Hz")
_BETWEEN = re.compile(rf"{_NUMBER}\s*(?:Hz\s*)?to\s*{_NUMBER}\s*Hz")
_FORMS = "write '> 8 Hz', '>= 8 Hz', '< 20 Hz', '<= 20 Hz' or '9 to 11 Hz'"


@dataclass(frozen=True)
class Band:
    """The range of healthy rates in Hz. A bound is exclusive if ``strict``."""

    low: Fraction | None
    high: Fraction | None
    strict: bool = False

    @classmethod
    def parse(cls, text: str) -> Band:
        """Parse a range such as ``> 8 Hz`` or ``9 to 11 Hz``.

        Raises ValueError, which names the accepted forms, if the text is none of them or no rate can be in the range.
        """
        text = text.strip()
        if match := _BOUND.fullmatch(text):
            sign, rate = match[1], Fraction(match[2])
            strict = len(sign) == 1
            band = cls(rate, None, strict) if sign.startswith(">") else cls(None, rate, strict)
        elif match := _BETWEEN.fullmatch(text):
            band = cls(Fraction(match[1]), Fraction(match[2]))
        else:
            raise ValueError(f"{text!r} is not a rate: {_FORMS}")
        if band.low is not None and band.high is not None and band.low >= band.high:
            raise ValueError(f"no rate is within {text!r}: write the lower bound first, such as '9 to 11 Hz'")
        if band.high == 0 or (band.low == 0 and band.high is None):
            raise ValueError(f"{text!r} sets no limit: a bound must be above 0 Hz")
        if max(band.low or 0, band.high or 0) > HIGHEST:
            raise ValueError(f"{text!r} is too fast to be watched: a bound must be at most {HIGHEST} Hz")
        return band

    def __str__(self) -> str:
        if self.low is not None and self.high is not None:
            return f"{hertz(self.low)[:-3]} to {hertz(self.high)}"
        if self.low is not None:
            return f"{'>' if self.strict else '>='} {hertz(self.low)}"
        return f"{'<' if self.strict else '<='} {hertz(self.high or Fraction(0))}"

    @property
    def expected(self) -> float:
        """The expected rate in Hz: the upper bound, or twice the lower one."""
        if self.high is not None:
            return float(self.high)
        return 2 * float(self.low or 0)

    def shortest_window(self) -> float:
        """The shortest window, in seconds, in which a steady rate inside the band is always counted as inside.

        A window counts a steady rate as one of two neighbouring numbers, so a band must be at least two samples wide in
        it.
        """
        width = self.high - self.low if self.low is not None and self.high is not None else self.low or self.high
        assert width, "a band has a bound above 0"
        return float(2 / width)

    def default_window(self) -> float:
        """The window in seconds if none is given: 2 s, or longer if ten samples or the band need it."""
        slowest = self.low if self.low else self.high
        assert slowest, "a band has a bound above 0"
        return max(2.0, float(10 / slowest), self.shortest_window())


def hertz(rate: Fraction | float) -> str:
    """Format a rate, such as ``6.1 Hz``."""
    return f"{float(rate):.4g} Hz"


class Window:
    """Counts the samples of one topic in a sliding window, and computes in advance when the count leaves a band."""

    def __init__(self, band: Band, window: float) -> None:
        """``window`` is the window's length in seconds."""
        self.band = band
        self.length = window
        # Durations are written as decimals. The difference to the nearest float must not shift a bound by one sample.
        exact = Fraction(window).limit_denominator(1_000_000)
        self.least = 0
        """The least count inside the band."""
        self.most: int | None = None
        """The greatest count inside the band; None if it is unbounded."""
        if band.low is not None:
            samples = band.low * exact
            self.least = math.floor(samples) + 1 if band.strict else math.ceil(samples)
        if band.high is not None:
            samples = band.high * exact
            self.most = math.ceil(samples) - 1 if band.strict else math.floor(samples)

    def leaves(self, arrival: float) -> float:
        """Return when a sample leaves the window."""
        return arrival + self.length

    def count(self, arrivals: Sequence[float], now: float) -> int:
        """Return the number of samples in the window that ends now. Arrivals are in order of time, and none is after
        now."""
        return len(arrivals) - bisect_right(arrivals, now, key=self.leaves)

    def holds(self, arrivals: Sequence[float], now: float) -> bool:
        """Return whether the count in the window that ends now is inside the band."""
        return now < self.until(arrivals) and not self.exceeded(arrivals, now)

    def until(self, arrivals: Sequence[float]) -> float:
        """Return when the count falls below the band if nothing more arrives: when the last necessary sample leaves the
        window."""
        if not self.least:
            return math.inf
        return self.leaves(arrivals[-self.least]) if len(arrivals) >= self.least else -math.inf

    def exceeded(self, arrivals: Sequence[float], now: float) -> bool:
        """Return whether the count in the window that ends now is above the band."""
        most = self.most
        return most is not None and len(arrivals) > most and now < self.leaves(arrivals[-most - 1])

    def changes(self, arrivals: Sequence[float]) -> list[float]:
        """Return when the count enters or leaves the band if nothing more arrives, including past times."""
        moments = [self.until(arrivals)]
        if self.most is not None and len(arrivals) > self.most:
            moments.append(self.leaves(arrivals[-self.most - 1]))
        return [moment for moment in moments if math.isfinite(moment)]

    def rate(self, arrivals: Sequence[float], now: float) -> float:
        """Return the rate in Hz over the window that ends now."""
        return self.count(arrivals, now) / self.length
