"""Ownership strengths of instances: every new one is weaker than all before it, so no running one needs to change.

Imports nothing of ROS: an init container writes strengths.
"""

from __future__ import annotations

BEGIN = 1767225600.0
"""2026-01-01T00:00:00Z in Unix seconds, from which strengths fall."""

STRONGEST = 0xFFFFFFFF
"""DDS strengths are unsigned and have 32 bits; in tenths of seconds they last for 13 years."""

PER_SECOND = 10


def strength(at: float) -> int:
    """The strength of an instance whose processes start at a time, in Unix seconds of its own node's clock."""
    return min(STRONGEST, max(0, STRONGEST - int((at - BEGIN) * PER_SECOND)))
