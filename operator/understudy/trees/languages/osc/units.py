"""Physical types of values in a health tree, with their units.

The units of time are the standard's (types.osc of its domain model), in which ``m`` is a metre. The standard has no
frequency, so our library declares it with its units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class Unit:
    """A unit of a physical type."""

    factor: Fraction
    """The value of one unit in the type's SI unit."""
    short: str
    """A unit of the short form."""
    scale: int = 1
    """The value of one unit in that unit of the short form."""


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
"""Types that our library declares with their units, because the standard does not have them. Their units are all of the
dimension 1/s."""
