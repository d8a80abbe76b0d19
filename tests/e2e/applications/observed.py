"""An application for tests, run in a pod: it has something for each kind of leaf of a health tree to look at, and breaks one of them.

It turns on the spot, at the speed of its parameter `speed`, from the first call of its service /begin on. The call succeeds only after the
parameter was set. So an instance drives only if a procedure has done both.

The file FAULT contains what is broken: the name of a leaf, `service` (there is no /begin) or `mode` (the parameter `mode` is manual).
Nothing else changes. Without the file, service and mode are as before.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, TransformStamped, TwistStamped
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_msgs.msg import Float32, String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from tf2_msgs.msg import TFMessage

FAULT = Path(os.environ.get("FAULT", "/tmp/fault"))

PERIOD = 0.1
"""Seconds between two commands, and between two messages on each topic."""

OLD = 60.0
"""Age in seconds of the messages on /measured while the fault is `age`."""

ASKED_AGAIN = 3.0
"""Seconds after which the goal is sent again: its server may not have known the client yet."""


class Worker(Node):
    """The server of /work, which works on one goal without end. Its feedback is the number of steps that are done."""

    def __init__(self) -> None:
        super().__init__("worker")
        self.broken = self.working = False
        self._server = ActionServer(self, Fibonacci, "/work", self._work)

    def _work(self, handle) -> Fibonacci.Result:
        self.working = True
        steps = 0
        while rclpy.ok():
            steps += not self.broken
            handle.publish_feedback(Fibonacci.Feedback(sequence=[steps]))
            time.sleep(2 * PERIOD)
        return Fibonacci.Result()


class Observed(Node):
    """Drives and publishes, and breaks what it is asked to."""

    def __init__(self, executor: SingleThreadedExecutor, worker: Worker) -> None:
        super().__init__("observed")
        self._executor, self._worker, self._fault = executor, worker, ""
        self._asked = 0.0
        self._driving = False
        self.declare_parameter("speed", 0.0)
        self.declare_parameter("mode", "auto")
        self._commands = self.create_publisher(TwistStamped, "/cmd_vel", 1)
        self._charge = self.create_publisher(Float32, "/charge", 10)
        self._measured = self.create_publisher(PointStamped, "/measured", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._transforms = self.create_publisher(TFMessage, "/tf", 10)
        self._plans = self.create_publisher(String, "/plan", 10)
        self._service = self._make_service()
        self._client = ActionClient(self, Fibonacci, "/work")
        self._helper = Node("helper")
        self._guide = LifecycleNode("guide")
        self._guide.trigger_configure()
        self._guide.trigger_activate()
        for node in (self, self._helper, self._guide):
            executor.add_node(node)
        self.create_timer(PERIOD, self._tell)

    def follow(self, fault: str) -> None:
        """Break what has this name; empty for nothing. Nodes and their parts cannot be removed in their own callbacks."""
        if fault == self._fault:
            return
        before, self._fault = self._fault, fault
        self._worker.broken = fault == "progress"
        match fault:
            case "publisher":
                self.destroy_publisher(self._plans)
            case "node":
                self._executor.remove_node(self._helper)
                self._helper.destroy_node()
            case "lifecycle":
                self._guide.trigger_deactivate()
            case "parameter":
                self.set_parameters([Parameter("speed", value=2 * self._speed)])
            case "mode":
                self.set_parameters([Parameter("mode", value="manual")])
            case "service":
                self.destroy_service(self._service)
        match before:
            case "mode":
                self.set_parameters([Parameter("mode", value="auto")])
            case "service":
                self._service = self._make_service()
        print(f"fault: {fault or 'none'}", flush=True)

    @property
    def _speed(self) -> float:
        return self.get_parameter("speed").value

    def _make_service(self):
        return self.create_service(Trigger, "/begin", self._begin)

    def _begin(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._driving = self._speed > 0.0
        print(f"begin: {response.success}, at {self._speed:g}", flush=True)
        return response

    def _tell(self) -> None:
        now = self.get_clock().now()
        if self._driving:
            command = TwistStamped()
            command.header.stamp, command.header.frame_id = now.to_msg(), os.environ.get("HOSTNAME", "")
            command.twist.linear.x, command.twist.angular.z = self._speed, 0.5
            self._commands.publish(command)
        self._charge.publish(Float32(data=0.125 if self._fault == "value" else 0.875))
        measured = PointStamped()
        age = OLD if self._fault == "age" else 0.0
        measured.header.stamp = Time(nanoseconds=now.nanoseconds - int(age * 1e9)).to_msg()
        self._measured.publish(measured)
        level = DiagnosticStatus.ERROR if self._fault == "diagnostics" else DiagnosticStatus.OK
        motor = DiagnosticStatus(
            name="drive: motor", level=level, message="hot" if self._fault == "diagnostics" else ""
        )
        radio = DiagnosticStatus(name="radio", level=DiagnosticStatus.ERROR, message="no carrier")
        self._diagnostics.publish(DiagnosticArray(status=[motor, radio]))
        frames = [("map", "odom")] + [("odom", "base_link")] * (self._fault != "transform")
        self._transforms.publish(TFMessage(transforms=[_transform(now, *one) for one in frames]))
        if self._fault == "log":
            self.get_logger().error("the motor is hot")
        if not self._worker.working and time.monotonic() > self._asked + ASKED_AGAIN and self._client.server_is_ready():
            self._asked = time.monotonic()
            self._client.send_goal_async(Fibonacci.Goal(order=1))


def _transform(now: Time, parent: str, child: str) -> TransformStamped:
    found = TransformStamped(child_frame_id=child)
    found.header.stamp, found.header.frame_id = now.to_msg(), parent
    return found


def _fault() -> str:
    try:
        return FAULT.read_text().strip()
    except FileNotFoundError:
        return ""


def main() -> None:
    rclpy.init()
    worker = Worker()
    working = SingleThreadedExecutor()
    working.add_node(worker)
    threading.Thread(target=working.spin, daemon=True).start()  # its goal occupies it
    executor = SingleThreadedExecutor()
    application = Observed(executor, worker)
    with contextlib.suppress(ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(timeout_sec=PERIOD)
            application.follow(_fault())


if __name__ == "__main__":
    main()
