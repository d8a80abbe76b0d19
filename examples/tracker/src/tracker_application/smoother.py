"""The node between who decides and the robot, as Nav2's velocity_smoother: cmd_vel_nav in, cmd_vel out.

It sends at its own pace whatever comes in, and zeros where nothing comes in. So a wrong remapping of its input leaves all
that can be looked at inside as it was, nodes, topics and rates, and the robot stands.
"""

from __future__ import annotations

import time

from geometry_msgs.msg import TwistStamped
from rclpy.node import Node

INPUT = "cmd_vel_nav"
ELSEWHERE = "cmd_vel_elsewhere"
"""What the input is remapped to when that goes wrong."""

PERIOD = 0.05
"""Seconds between commands."""

TIMEOUT = 0.5
"""Age in seconds at which what came in counts no more."""

ACCELERATION, TURN_ACCELERATION = 2.0, 4.0
"""The largest change of its commands, in m/s2 and rad/s2."""


class Smoother(Node):
    """Sends commands steadily."""

    def __init__(self, name: str) -> None:
        super().__init__("velocity_smoother")
        self._name = name
        self._wanted = (0.0, 0.0)
        self._heard: float | None = None
        self._sent = (0.0, 0.0)
        self._remap = False
        self._commands = self.create_publisher(TwistStamped, "cmd_vel", 10)
        self._input = self.create_subscription(TwistStamped, INPUT, self._hear, 1)
        self.create_timer(PERIOD, self._send)

    def misremap(self) -> None:
        """From now on it is as if it had been started with ``-r velocity_smoother:cmd_vel_nav:=cmd_vel_elsewhere``.

        May be called by a signal's handler.
        """
        self._remap = True

    def _hear(self, message: TwistStamped) -> None:
        self._wanted, self._heard = (message.twist.linear.x, message.twist.angular.z), time.monotonic()

    def _send(self) -> None:
        if self._remap:
            self._remap = False
            self.destroy_subscription(self._input)
            self._input = self.create_subscription(TwistStamped, ELSEWHERE, self._hear, 1)
        if self._heard is None:
            return  # nobody has decided anything yet
        wanted = self._wanted if time.monotonic() - self._heard < TIMEOUT else (0.0, 0.0)
        speed, turn = (
            before + max(-most * PERIOD, min(most * PERIOD, value - before))
            for before, value, most in zip(self._sent, wanted, (ACCELERATION, TURN_ACCELERATION), strict=True)
        )
        self._sent = speed, turn
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        # Who sends it, so that the robot's log can tell instances apart; the robot has no other use for it.
        message.header.frame_id = self._name
        message.twist.linear.x, message.twist.angular.z = speed, turn
        self._commands.publish(message)
