"""What the base makes of commands: limits of speed and acceleration, and a watchdog, as real bases have them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """What the base drives at most, in m, rad and s."""

    speed: float = 0.5
    turn: float = 1.5
    acceleration: float = 1.0
    braking: float = 2.0
    turn_acceleration: float = 5.0


def approached(value: float, target: float, *, up: float, down: float) -> float:
    """One step from a speed towards another: at most ``up`` away from zero, at most ``down`` towards it."""
    slower = value * target < 0 or abs(target) < abs(value)
    step = down if slower else up
    # A reversal brakes to zero first.
    goal = 0.0 if value * target < 0 else target
    return max(goal, value - step) if value > goal else min(goal, value + step)


class Base:
    """Turns commands into the speeds that the motors are asked for. Times are seconds of any steady clock."""

    def __init__(self, limits: Limits | None = None, *, watchdog: float = 0.5) -> None:
        """``watchdog`` is the age in seconds at which a command counts no more (cmd_vel_timeout of ros2_controllers)."""
        self.speed = 0.0
        self.turn = 0.0
        self._limits = limits or Limits()
        self._watchdog = watchdog
        self._target = (0.0, 0.0)
        self._commanded: float | None = None

    def command(self, linear: float, angular: float, *, now: float) -> None:
        """Take a command, cut down to what the base drives at most."""
        limits = self._limits
        self._target = (
            max(-limits.speed, min(limits.speed, linear)),
            max(-limits.turn, min(limits.turn, angular)),
        )
        self._commanded = now

    def held(self, now: float) -> bool:
        """Whether the watchdog holds the base because no commands arrive."""
        return self._commanded is None or now - self._commanded > self._watchdog

    def advance(self, now: float, seconds: float) -> tuple[float, float]:
        """Forward speed in m/s and turn rate in rad/s to ask for, ``seconds`` after the last time."""
        linear, angular = (0.0, 0.0) if self.held(now) else self._target
        limits = self._limits
        self.speed = approached(self.speed, linear, up=limits.acceleration * seconds, down=limits.braking * seconds)
        turned = limits.turn_acceleration * seconds
        self.turn = approached(self.turn, angular, up=turned, down=turned)
        return self.speed, self.turn
