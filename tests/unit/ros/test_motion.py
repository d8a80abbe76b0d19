"""The leaf `motion` over real DDS: commands and odometry of different nodes, compared as they are received."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.agent.instance_health import _OwnOutputs
from understudy.ros.runtime.graph_node import Graph

pytestmark = pytest.mark.ros

PERIOD = 0.05
LEAF = {"motion": {"topic": "/seen", "commands": "/cmd_vel"}}


class Driving:
    """Commands and odometry every 50 ms, until it is over."""

    def __init__(self, graph: Graph, stamped: bool) -> None:
        from geometry_msgs.msg import Twist, TwistStamped
        from nav_msgs.msg import Odometry

        self.commanded = self.odometry_speed = 0.3
        self._over = threading.Event()
        type_ = TwistStamped if stamped else Twist
        self._commands = graph.node.create_publisher(type_, "/cmd_vel", 10)
        self._odometry = graph.node.create_publisher(Odometry, "/seen", 10)
        self._types: tuple[Any, Any] = type_, Odometry
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(PERIOD):
            command, odometry = (type_() for type_ in self._types)
            twist = command.twist if hasattr(command, "twist") else command
            twist.linear.x = self.commanded
            odometry.twist.twist.linear.x = self.odometry_speed
            odometry.twist.covariance = [1e-6 if index % 7 == 0 else 0.0 for index in range(36)]
            self._commands.publish(command)
            self._odometry.publish(odometry)

    def close(self) -> None:
        self._over.set()
        self._thread.join()


@pytest.fixture(params=[False, True], ids=["Twist", "TwistStamped"])
def driving(dds: None, request: pytest.FixtureRequest) -> Iterator[Driving]:
    graph = Graph("driving")
    made = Driving(graph, request.param)
    yield made
    made.close()
    graph.close()


def test_a_robot_that_stands_despite_a_command_is_detected(watching, driving, eventually):
    judged = Judged(watching, LEAF)

    def reason() -> str:
        (leaf,) = judged.tree.root.iterate()
        return str(leaf.reason("Healthy"))

    eventually(lambda: judged.now().state == "Healthy" and reason() == "the robot moves as /cmd_vel commands")
    driving.odometry_speed = 0.0
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "/cmd_vel", "/seen", "0.00 m/s", "0.30 m/s")
    own = _OwnOutputs(watching, [], b"")
    there = judged.tree.evaluate(own, now=time.time(), since=judged.since)
    assert there.state == "Healthy", "in a standby's agent: what the robot does is another's doing"
    driving.commanded = 0.0
    eventually(lambda: judged.now().state == "Healthy")
