"""What the arm makes of commands: a reference that its servos follow, and hold when commands end."""

from __future__ import annotations

import numpy as np
from manipulation_arm import Joints

HELD = 0.06
"""s without a command after which the arm holds; three periods of the commands."""


class Controller:
    """The reference. Times are seconds of any steady clock."""

    def __init__(self, start: Joints) -> None:
        self.positions = start.copy()
        self._velocities = np.zeros(len(start))
        self._commanded: float | None = None

    def command(self, positions: Joints, velocities: Joints, *, now: float) -> float:
        """Take a command; returns the largest step of a joint that is sent at once, in rad."""
        step = float(np.abs(positions - self.positions).max())
        self.positions, self._velocities = positions, velocities
        self._commanded = now
        return step

    def stay(self, *, now: float) -> float:
        """Take a command to stay where it is; returns the step that is sent, in rad, which is none."""
        return self.command(self.positions, self._velocities * 0.0, now=now)

    def held(self, now: float) -> bool:
        """Whether the arm holds because no commands arrive."""
        return self._commanded is None or now - self._commanded > HELD

    def velocities(self, now: float) -> Joints:
        """How fast the reference moves."""
        return self._velocities * 0.0 if self.held(now) else self._velocities
