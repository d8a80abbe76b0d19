"""Ownership strengths of instances. Every new instance is weaker than all earlier ones, so no running one has to change.

Does not import ROS, because an init container uses it.
"""

from __future__ import annotations

BEGIN = 1767225600.0
"""2026-01-01T00:00:00Z in Unix seconds. Strengths decrease from then on."""

STRONGEST = 0xFFFFFFFF
"""DDS strengths are unsigned 32-bit numbers. In tenths of a second they last for 13 years."""

PER_SECOND = 10


def strength(at: float) -> int:
    """Return the strength of an instance whose processes start at this time, in Unix seconds of its node's clock."""
    return min(STRONGEST, max(0, STRONGEST - int((at - BEGIN) * PER_SECOND)))
