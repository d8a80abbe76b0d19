"""An application that has something to lose, and its client. Runs in pods: ``worker.py drive``, ``worker.py client``.

The application counts its steps, publishes the count, and goes on from one that it is given on /restore_progress. It serves the action
/goto. Its commands say in their frame which pod sent them, at which step, and which goal was finished since the command before, so
that the robot's own log shows what was lost and what was done twice.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import deque

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int64
from test_msgs.action import Fibonacci

ACTION = "/goto"
PERIOD = 0.05
STEP = 0.25
"""Seconds of one step of a goal."""

ANSWERED_WITHIN = 20.0
"""Seconds after which the client sends a request again, as clients must: one that is sent when its server has just ended is lost."""

STATUSES = {4: "succeeded", 5: "canceled", 6: "aborted"}


class Worker(Node):
    """Commands at 20 Hz, with the usual depth of 10."""

    def __init__(self) -> None:
        super().__init__("worker")
        self._pod, self._step = os.environ["HOSTNAME"], 0
        self._finished: deque[str] = deque()
        self._commands = self.create_publisher(TwistStamped, "/cmd_vel", 10)
        self._progress = self.create_publisher(Int64, "/progress", 10)
        self.create_subscription(Int64, "/restore_progress", self._restored, 10)
        self.create_timer(PERIOD, self._drive)
        self._server = ActionServer(
            self, Fibonacci, ACTION, execute_callback=self._execute, callback_group=ReentrantCallbackGroup()
        )

    def _restored(self, message: Int64) -> None:
        self.get_logger().info(f"goes on from step {message.data}")
        self._step = message.data

    def _drive(self) -> None:
        self._step += 1
        finished = self._finished.popleft() if self._finished else ""
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = f"{self._pod} {self._step} {finished}"
        message.twist.angular.z = 0.2
        self._commands.publish(message)
        self._progress.publish(Int64(data=self._step))

    def _execute(self, handle):  # type: ignore[no-untyped-def]
        try:
            for number in range(handle.request.order):
                handle.publish_feedback(Fibonacci.Feedback(sequence=[number]))
                time.sleep(STEP)
            handle.succeed()
        except RuntimeError:
            if rclpy.ok():  # otherwise the pod is being deleted
                raise
            return Fibonacci.Result()
        self._finished.append(bytes(handle.goal_id.uuid).hex())
        return Fibonacci.Result(sequence=[handle.request.order])


def drive() -> None:
    """Run the application."""
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=16)  # each goal takes one
        executor.add_node(Worker())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (RuntimeError, ValueError, NotInitializedException):
        if rclpy.ok():  # otherwise the pod is being deleted while the node is made
            raise


def client(order: int) -> None:
    """Send one goal after the other, and say how each ended."""

    def say(**words: object) -> None:
        print(json.dumps({"time": time.time(), **words}), flush=True)

    rclpy.init()
    node = rclpy.create_node("customer")
    actions = ActionClient(node, Fibonacci, ACTION)
    while True:
        actions.wait_for_server()
        sent = actions.send_goal_async(Fibonacci.Goal(order=order))
        rclpy.spin_until_future_complete(node, sent, timeout_sec=ANSWERED_WITHIN)
        if not sent.done():
            say(event="unanswered")
            continue
        handle = sent.result()
        goal = bytes(handle.goal_id.uuid).hex()
        say(event="answered", goal=goal, accepted=handle.accepted)
        if not handle.accepted:
            time.sleep(1.0)
            continue
        asked = [handle.get_result_async()]
        while not (done := [one for one in asked if one.done()]):
            rclpy.spin_until_future_complete(node, asked[-1], timeout_sec=order * STEP + ANSWERED_WITHIN)
            if not any(one.done() for one in asked):
                asked.append(handle.get_result_async())
        status = done[0].result().status
        say(event="ended", goal=goal, status=STATUSES.get(status, str(status)))


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(int(sys.argv[2]))
    else:
        drive()
