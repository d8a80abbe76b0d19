"""Requests and goals are forwarded from one instance at a time, over real DDS, and what the robot returns reaches whoever asked."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from pydantic import TypeAdapter

pytest.importorskip("rclpy")

from tests.unit.ros.processes import Processes
from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.ros.dds.profiles import mux_profiles_xml, muxed_profiles_xml

pytestmark = pytest.mark.ros

OUTPUTS = [
    Output(service="/horn", type="std_srvs/srv/SetBool"),
    Output(action="/lift", type="test_msgs/action/Fibonacci"),
]

ROBOT = """
import rclpy
from rclpy.action import ActionServer
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

rclpy.init()
node = Node("robot")

def horn(request, response):
    response.success, response.message = True, "sounded"
    return response

def lift(goal):
    goal.publish_feedback(Fibonacci.Feedback(sequence=[7]))
    goal.succeed()
    return Fibonacci.Result(sequence=[goal.request.order])

node.create_service(SetBool, "/horn", horn)
ActionServer(node, Fibonacci, "/lift", lift)
print("ready", flush=True)
rclpy.spin(node, MultiThreadedExecutor())
"""

INSTANCE = """
import sys, threading
import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

rclpy.init()
node = Node("instance")
horn, lift = node.create_client(SetBool, "/horn"), ActionClient(node, Fibonacci, "/lift")
threading.Thread(target=lambda: rclpy.spin(node), daemon=True).start()
print("ready", flush=True)

def done(future, seconds):
    ended = threading.Event()
    future.add_done_callback(lambda _: ended.set())
    return ended.wait(seconds)

for line in sys.stdin:
    word, seconds = line.split()
    answer = "nothing"
    if word == "horn" and horn.wait_for_service(float(seconds)):
        future = horn.call_async(SetBool.Request(data=True))
        if done(future, float(seconds)):
            answer = future.result().message
        else:
            horn.remove_pending_request(future)
    if word == "lift" and lift.wait_for_server(float(seconds)):
        fed = []
        future = lift.send_goal_async(Fibonacci.Goal(order=3), lambda message: fed.extend(message.feedback.sequence))
        if done(future, float(seconds)) and future.result().accepted:
            result = future.result().get_result_async()
            if done(result, float(seconds)):
                answer = f"{list(result.result().result.sequence)} {fed}"
    print(answer, flush=True)
"""


class Stand:
    """A robot, a mux and instances."""

    def __init__(self, processes: Processes, folder: Path) -> None:
        for name, text in (("robot", ROBOT), ("instance", INSTANCE)):
            (folder / f"{name}.py").write_text(text)
        (folder / "instance.xml").write_text(muxed_profiles_xml(OUTPUTS))
        (folder / "mux.xml").write_text(mux_profiles_xml(OUTPUTS))
        self._processes, self._folder = processes, folder
        self.mux = processes.node(
            TypeAdapter(list[Output]).dump_json(OUTPUTS, exclude_none=True).decode(),
            script="forwarding.py",
            FASTRTPS_DEFAULT_PROFILES_FILE=str(folder / "mux.xml"),
        )

    def robot(self) -> subprocess.Popen[str]:
        return self._processes.node(script=str(self._folder / "robot.py"))

    def instance(self, pod: str) -> subprocess.Popen[str]:
        return self._processes.node(
            script=str(self._folder / "instance.py"),
            FASTRTPS_DEFAULT_PROFILES_FILE=str(self._folder / "instance.xml"),
            **{names.POD_VARIABLE: pod},
        )

    def forward(self, pod: str) -> int:
        """Have an instance forwarded. Returns how many commands were forwarded before."""
        print(pod, file=self.mux.stdin, flush=True)
        return int(self._processes.line(self.mux, 60))

    def asks(self, instance: subprocess.Popen[str], word: str, *, within: float = 20.0) -> str:
        """Have an instance call the robot, and return what it received."""
        print(word, within, file=instance.stdin, flush=True)
        return self._processes.line(instance, 5 * within)


@pytest.fixture
def stand(processes: Processes, discovery_server: object, tmp_path: Path) -> Stand:
    discovery_server()  # type: ignore[operator]
    return Stand(processes, tmp_path)


def test_requests_and_goals_reach_the_robot_from_the_instance_in_control_only(stand: Stand) -> None:
    stand.robot()
    first, second = stand.instance("w-1"), stand.instance("w-2")
    stand.forward("w-1")
    assert stand.asks(first, "horn") == "sounded"
    assert stand.asks(first, "lift") == "[3] [7]"
    assert stand.asks(second, "horn", within=1.0) == "nothing"
    assert stand.asks(second, "lift", within=1.0) == "nothing"
    stand.forward("w-2")
    assert stand.asks(second, "horn") == "sounded"
    assert stand.asks(second, "lift") == "[3] [7]"
    assert stand.asks(first, "horn", within=1.0) == "nothing"


def test_an_instance_waits_for_the_robots_server_and_not_for_the_mux(stand: Stand) -> None:
    first = stand.instance("w-1")
    stand.forward("w-1")
    assert stand.asks(first, "horn", within=2.0) == "nothing"
    stand.robot()
    assert stand.asks(first, "horn") == "sounded"
