"""A topic is forwarded from one instance at a time, over real DDS: writers in partitions of their own, and a robot without a profile."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

pytest.importorskip("rclpy")

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.ros.actions.forwarded_topic import offered
from understudy.ros.dds.profiles import instance_of, mux_profiles_xml, muxed_profiles_xml

pytestmark = pytest.mark.ros

CHAT, TYPE = "/chat", "std_msgs/msg/String"
OUTPUTS = [Output(topic=CHAT, type=TYPE)]

TALK = """
import sys, time
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
publisher = Node("talker").create_publisher(String, "/chat", QoSProfile(depth=10))
print("ready", flush=True)
number = 0
while True:
    number += 1
    publisher.publish(String(data=f"{sys.argv[1]} {number}"))
    time.sleep(0.02)
"""

HEAR = """
import sys, threading, time
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node, heard = Node("robot"), []
node.create_subscription(String, "/chat", lambda message: heard.append(message.data), QoSProfile(depth=10))
threading.Thread(target=lambda: rclpy.spin(node), daemon=True).start()
print("ready", flush=True)
for _ in sys.stdin:
    print(" ".join(heard), flush=True)
    heard.clear()
"""


class Stand:
    """A robot, a mux and two instances."""

    def __init__(self, processes: Any, folder: Path) -> None:
        (folder / "talk.py").write_text(TALK)
        (folder / "hear.py").write_text(HEAR)
        (folder / "instance.xml").write_text(muxed_profiles_xml(OUTPUTS))
        (folder / "mux.xml").write_text(mux_profiles_xml(OUTPUTS))
        self._processes, self._folder = processes, folder
        self.robot = processes.node(script=str(folder / "hear.py"))
        self.mux = processes.node(
            TypeAdapter(list[Output]).dump_json(OUTPUTS, exclude_none=True).decode(),
            script="forwarding.py",
            FASTRTPS_DEFAULT_PROFILES_FILE=str(folder / "mux.xml"),
        )

    def instance(self, pod: str, *, muxed: bool = True) -> subprocess.Popen[str]:
        profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(self._folder / "instance.xml")} if muxed else {}
        node: subprocess.Popen[str] = self._processes.node(
            pod, script=str(self._folder / "talk.py"), **{names.POD_VARIABLE: pod, **profile}
        )
        return node

    def forward(self, pod: str) -> int:
        """Have an instance forwarded. Returns how many samples were forwarded before."""
        print(pod, file=self.mux.stdin, flush=True)
        return int(self._processes.line(self.mux, 60))

    def heard(self, *, after: float = 0.0) -> list[tuple[str, int]]:
        """Return what the robot received since it was asked last: the pods and their numbers."""
        time.sleep(after)
        print(file=self.robot.stdin, flush=True)
        words = self._processes.line(self.robot, 30).split()
        return [(pod, int(number)) for pod, number in zip(words[::2], words[1::2], strict=True)]

    def until_heard(self, pod: str) -> None:
        end = time.monotonic() + 30
        while pod not in dict(self.heard(after=0.1)):
            assert time.monotonic() < end, f"{pod} was not heard"


@pytest.fixture
def stand(processes: Any, discovery_server: Any, tmp_path: Path) -> Stand:
    discovery_server()
    return Stand(processes, tmp_path)


def test_a_robot_without_a_profile_receives_one_instance_and_nothing_that_it_sent_before(stand: Stand) -> None:
    stand.instance("w-1")
    stand.instance("w-2")
    assert stand.heard(after=1.0) == [], "nobody is forwarded yet"
    stand.forward("w-1")
    stand.until_heard("w-1")
    first = stand.heard(after=1.0)
    assert {pod for pod, _ in first} == {"w-1"}
    numbers = [number for _, number in first]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "none is lost, and none comes twice"
    stand.forward("w-2")
    second = stand.heard(after=1.0)
    pods = [pod for pod, _ in second]
    assert pods == sorted(pods), "nothing of the former one after the first of the next one"
    numbers = [number for pod, number in second if pod == "w-2"]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) <= 1.5 / 0.02, "its history is not delivered"
    before = stand.forward("")
    assert before > 50
    stand.heard(after=0.2)
    assert stand.heard(after=0.5) == [], "nobody is forwarded any more"


def test_an_instance_without_a_partition_is_not_forwarded_and_an_unknown_one_neither(stand: Stand) -> None:
    stand.instance("w-1")
    stand.instance("w-2")
    stand.forward("w-1")
    stand.until_heard("w-1")
    stand.instance("w-9", muxed=False)
    stand.until_heard("w-9")
    assert stand.forward("w-1") < stand.forward("w-1") + 1
    by_mux = [pod for pod, _ in stand.heard(after=0.5)]
    assert "w-2" not in by_mux


def test_the_partition_names_the_instance() -> None:
    assert instance_of(["understudy-w-1"]) == "w-1"
    assert instance_of([]) == instance_of(["lab"]) == instance_of(["understudy-w-1", "understudy-w-2"]) == ""


def test_what_is_offered_matches_every_reader() -> None:
    assert offered([]).reliability == ReliabilityPolicy.RELIABLE
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    strict = QoSProfile(depth=1, deadline=Duration(nanoseconds=200_000_000))
    assert offered([best_effort]).durability == DurabilityPolicy.VOLATILE
    found = offered([best_effort, latched, strict])
    assert found.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert found.deadline.nanoseconds == 200_000_000
