"""Physical types that values of a health tree can have, with their units.

Those of time are the standard's (types.osc of its domain model), in which ``m`` is a metre. It has none of frequency, so our library
declares them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class Unit:
    """A unit of a physical type."""

    factor: Fraction
    """How many of the type's SI unit it is."""
    short: str
    """How the short form writes it."""
    scale: int = 1
    """How many of those it is."""


MILLISECOND = Unit(Fraction(1, 1000), "ms")
SECOND = Unit(Fraction(1), "s")
MINUTE = Unit(Fraction(60), "m")
HOUR = Unit(Fraction(3600), "h")
HERTZ = Unit(Fraction(1), " Hz")
KILOHERTZ = Unit(Fraction(1000), " Hz", 1000)

UNITS: Mapping[str, Mapping[str, Unit]] = {
    "time": {
        "ms": MILLISECOND,
        "s": SECOND,
        "min": MINUTE,
        "h": HOUR,
        "millisecond": MILLISECOND,
        "sec": SECOND,
        "second": SECOND,
        "minute": MINUTE,
        "hour": HOUR,
    },
    "frequency": {"Hz": HERTZ, "kHz": KILOHERTZ, "hertz": HERTZ, "kilohertz": KILOHERTZ},
}
"""The units of each physical type, by their names."""

OWN = ("frequency",)
"""Types that our library declares with their units, since the standard has none; all of them are of so many per second."""
