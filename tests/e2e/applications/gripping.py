"""A gripper on the robot, and an application that drives and sends goals to it, for a test in which they run in pods.

`gripper`: serves /grip and prints each goal that arrives, one JSON object a line.
`application`: sends a command 20 times a second and a goal twice a second, and prints how many goals it has sent. A goal's id contains
the sender's name (its hash) and when it was sent.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import struct
import sys
import time

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from test_msgs.action import Fibonacci
from unique_identifier_msgs.msg import UUID

ACTION = "/grip"
COMMANDS, GOALS = 20, 2
"""In a second."""


def sender(name: str) -> str:
    """Return what a goal's id contains of its sender's name."""
    return hashlib.sha256(name.encode()).hexdigest()[:16]


class Gripper(Node):
    """Reaches every goal at once."""

    def __init__(self) -> None:
        super().__init__("gripper")
        self._server = ActionServer(self, Fibonacci, ACTION, self._grip)

    def _grip(self, handle) -> Fibonacci.Result:
        name, sent = struct.unpack(">8sd", bytes(handle.goal_id.uuid))
        print(json.dumps({"event": "goal", "sender": name.hex(), "sent": sent, "received": time.time()}), flush=True)
        handle.succeed()
        return Fibonacci.Result()


class Application(Node):
    """Sends commands and goals. No answers to the goals of a standby arrive, and it goes on."""

    def __init__(self, name: str) -> None:
        super().__init__("application")
        self._name, self._sent = name, 0
        self._commands = self.create_publisher(TwistStamped, "/cmd_vel", 1)
        self._client = ActionClient(self, Fibonacci, ACTION)
        self.create_timer(1 / COMMANDS, self._drive)
        self.create_timer(1 / GOALS, self._grip)

    def _drive(self) -> None:
        command = TwistStamped()
        command.header.stamp, command.header.frame_id = self.get_clock().now().to_msg(), self._name
        command.twist.angular.z = 0.5
        self._commands.publish(command)

    def _grip(self) -> None:
        if self._client.server_is_ready():
            name = struct.pack(">8sd", bytes.fromhex(sender(self._name)), time.time())
            self._client.send_goal_async(Fibonacci.Goal(order=1), goal_uuid=UUID(uuid=list(name)))
            self._sent += 1
            print(f"sent {self._sent}", flush=True)


def main(role: str) -> None:
    rclpy.init()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(Gripper() if role == "gripper" else Application(os.environ["HOSTNAME"]))


if __name__ == "__main__":
    main(sys.argv[1])
