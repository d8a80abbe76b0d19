"""The application of examples/forklift: drives, lifts, and has the beacon blink. A standby runs the same code.

The sender's name travels in the frame of the velocities, so that the truck's journal can tell the instances apart.
"""

from __future__ import annotations

import math
import os
import socket
import time

from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from understudy_quickstart.running import run

VELOCITIES, HEIGHTS, BLINKS = 25, 5, 1
"""Messages, and calls, in a second."""


class Forklift(Node):
    """Sends velocities and fork heights, and calls the truck's service."""

    def __init__(self, name: str) -> None:
        super().__init__("forklift")
        self._name, self._is_on = name, False
        self._calling: Future[SetBool.Response] | None = None
        self._velocities = self.create_publisher(TwistStamped, "/forklift/velocity", 10)
        self._heights = self.create_publisher(Float64, "/forklift/fork_height", 10)
        self._beacon = self.create_client(SetBool, "/forklift/beacon")
        self.create_timer(1 / VELOCITIES, self._drive)
        self.create_timer(1 / HEIGHTS, self._lift)
        self.create_timer(1 / BLINKS, self._blink)

    def _drive(self) -> None:
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._name
        message.twist.linear.x = 0.5
        self._velocities.publish(message)

    def _lift(self) -> None:
        self._heights.publish(Float64(data=1.0 + 0.5 * math.sin(time.time() / 5)))

    def _blink(self) -> None:
        if self._calling is not None:  # nobody answers a standby: its call does not reach the truck
            self._beacon.remove_pending_request(self._calling)
        if self._beacon.service_is_ready():
            self._is_on = not self._is_on
            self._calling = self._beacon.call_async(SetBool.Request(data=self._is_on))


def main() -> None:
    """Run the application until it is asked to stop."""
    run(lambda: Forklift(os.environ.get("HOSTNAME") or socket.gethostname()))


if __name__ == "__main__":
    main()
