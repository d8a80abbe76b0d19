"""With a mux, instances hear the robot and themselves, and not each other, over real DDS. The monitor hears all of them."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from understudy.api import names
from understudy.api.kinds.robot_workload import Gate, Output
from understudy.ros.rmw import MIDDLEWARE

pytestmark = pytest.mark.ros

OUTPUTS = [Output(topic="/cmd_vel", type="std_msgs/msg/String")]

TALK = """
import json, sys, threading, time
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

name, sent = sys.argv[1], sys.argv[2:]
rclpy.init()
node, heard = Node(name), {}
for topic in ("/scan", "/plan", "/cmd_vel"):
    node.create_subscription(String, topic, lambda message, t=topic: heard.setdefault(t, set()).add(message.data), 10)
publishers = [node.create_publisher(String, topic, 10) for topic in sent]
calls = 0

def activate(_, response):
    global calls
    calls += 1
    return response

client = node.create_client(Trigger, "/controller/activate")
if "/plan" in sent:
    node.create_service(Trigger, "/controller/activate", activate)
threading.Thread(target=lambda: rclpy.spin(node), daemon=True).start()

def talk():
    while True:
        for publisher in publishers:
            publisher.publish(String(data=name))
        time.sleep(0.05)

threading.Thread(target=talk, daemon=True).start()
print("ready", flush=True)
for line in sys.stdin:
    if line.strip() == "call":
        assert client.wait_for_service(10.0)
        client.call(Trigger.Request())
    found = {topic: sorted(names) for topic, names in heard.items()}
    nodes = sorted(node.get_node_names())
    print(json.dumps({"heard": found, "calls": calls, "nodes": nodes}), flush=True)
"""


class Stand:
    """A robot, a monitor and two instances of one workload, which have nodes, topics and services of the same names."""

    def __init__(self, processes: Any, folder: Path) -> None:
        gate = Gate(kind="Mux")
        settings = {
            "instance": MIDDLEWARE.instance_settings([], OUTPUTS, gate),
            "monitor": MIDDLEWARE.monitor_settings(OUTPUTS, gate),
        }
        (folder / "talk.py").write_text(TALK)
        for name, text in settings.items():
            (folder / f"{name}.xml").write_text(text)
        self._processes, self._folder = processes, folder
        self.robot = self._start("robot", "/scan")
        self.monitor = self._start("monitor", profiles="monitor")
        self.instances = [self._start(pod, "/plan", "/cmd_vel", profiles="instance", pod=pod) for pod in ("w_1", "w_2")]

    def _start(self, name: str, *sent: str, profiles: str = "", pod: str = "") -> Any:
        variables = {names.POD_VARIABLE: pod} if pod else {}
        if profiles:
            variables[MIDDLEWARE.settings_variable] = str(self._folder / f"{profiles}.xml")
        return self._processes.node(name, *sent, script=str(self._folder / "talk.py"), **variables)

    def ask(self, process: Any, what: str = "heard") -> dict[str, Any]:
        print(what, file=process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._processes.line(process, 30))
        return answer

    def until_heard(self, process: Any, expected: dict[str, list[str]]) -> None:
        end = time.monotonic() + 30
        while (found := self.ask(process))["heard"] != expected and time.monotonic() < end:
            time.sleep(0.1)
        assert found["heard"] == expected


@pytest.fixture
def stand(processes: Any, discovery_server: Any, tmp_path: Path) -> Stand:
    discovery_server()
    return Stand(processes, tmp_path)


def test_an_instance_hears_the_robot_and_itself_and_no_other_instance(stand: Stand) -> None:
    first, second = stand.instances
    for pod, instance in (("w_1", first), ("w_2", second)):
        stand.until_heard(instance, {"/scan": ["robot"], "/plan": [pod], "/cmd_vel": [pod]})
    stand.until_heard(stand.monitor, {"/scan": ["robot"], "/plan": ["w_1", "w_2"], "/cmd_vel": ["w_1", "w_2"]})
    stand.until_heard(stand.robot, {"/scan": ["robot"]})
    for _ in range(5):
        stand.ask(first, "call")
    assert (stand.ask(first)["calls"], stand.ask(second)["calls"]) == (5, 0)
    assert stand.ask(first)["nodes"] == ["monitor", "robot", "w_1"]
    assert stand.ask(stand.monitor)["nodes"] == ["monitor", "robot", "w_1", "w_2"]
