"""With the profile file in place, the readers of real nodes listen on their own gate ports, and on no other's."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

from tests.unit.ros.processes import PACKAGE
from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.ros.dds.profiles import gate_ports, profiles_xml

pytestmark = pytest.mark.ros

OUTPUTS = [
    Output(topic="/robot/chat", type="std_msgs/msg/String"),
    Output(service="/robot/snap", type="std_srvs/srv/Trigger"),
    Output(action="/robot/goto", type="test_msgs/action/Fibonacci"),
]


def listening(pid: int) -> set[int]:
    """The UDP ports that a process has open."""
    inodes = {link[8:-1] for fd in os.listdir(f"/proc/{pid}/fd") if (link := _link(pid, fd)).startswith("socket:[")}
    with open(f"/proc/{pid}/net/udp") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    return {int(row[1].split(":")[1], 16) for row in rows if row[9] in inodes}


def _link(pid: int, fd: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/fd/{fd}")
    except FileNotFoundError:
        return ""


def gated(pid: int) -> set[int]:
    return {port for port in listening(pid) if names.GATE_RANGE[0] <= port <= names.GATE_RANGE[1]}


@pytest.fixture
def profiles(dds, tmp_path):
    file = tmp_path / "profiles.xml"
    file.write_text(profiles_xml(OUTPUTS))
    return str(file)


def test_every_reader_of_a_robot_listens_on_its_own_port(processes, profiles):
    robot = processes.node(
        "robot", "/robot/chat", "/robot/snap", "/robot/goto", FASTRTPS_DEFAULT_PROFILES_FILE=profiles
    )
    assert gated(robot.pid) == set(gate_ports(OUTPUTS).values())


def test_readers_with_other_names_do_not_use_gate_ports(processes, profiles):
    robot = processes.node(
        "robot", "/other/chat", "/other/snap", "/other/goto", FASTRTPS_DEFAULT_PROFILES_FILE=profiles
    )
    assert gated(robot.pid) == set()


MONITOR = """
import sys
import time
from understudy.ros.runtime.graph_node import Graph
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.trees.core.health_tree import WatchedTopic
watching = TopicWatch(Graph("monitor"))
watching.follow([WatchedTopic("/robot/chat", "std_msgs/msg/String", 0.0, None)])
print("follows", flush=True)
while not (watching.drain() and watching.topic("/robot/chat").count > 5):
    time.sleep(0.01)
print("received", flush=True)
sys.stdin.readline()
"""


def test_commands_arrive_at_the_gate_port(processes, profiles):
    """In a process of its own, since the middleware reads the file once for all participants of a process."""
    monitor = subprocess.Popen(
        [sys.executable, "-c", MONITOR],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(PACKAGE), "FASTRTPS_DEFAULT_PROFILES_FILE": profiles},
    )
    try:
        assert processes.line(monitor, 30) == "follows"
        assert gated(monitor.pid) == {gate_ports(OUTPUTS)["/robot/chat"]}
        processes.node("publish", "/robot/chat", "50")
        assert processes.line(monitor, 30) == "received"
    finally:
        monitor.kill()
        monitor.communicate()
