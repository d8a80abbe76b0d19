"""What an instance sent while the gate was closed for it does not reach the robot when the gate opens."""

from __future__ import annotations

import os
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.network_namespaces import Network, fence, network
from tests.unit.ros.commands import ACTION, LATCHED, SERVICE, TOPIC, UNLIMITED
from tests.unit.ros.processes import Processes
from understudy.api.kinds.robot_workload import Output
from understudy.ros.dds.profiles import instance_profiles_xml, profiles_xml

LIFESPANS = {TOPIC: 0.1, UNLIMITED: 0.1, LATCHED: 0.1, SERVICE: 1.0, ACTION: 0.3}
"""Of each output, in seconds."""

OUTPUTS = [
    *(Output(topic=topic, type="std_msgs/msg/String") for topic in (TOPIC, UNLIMITED, LATCHED)),
    Output(service=SERVICE, type="test_msgs/srv/BasicTypes"),
    Output(action=ACTION, type="test_msgs/action/Fibonacci", lifespan="300ms"),
]

MARGIN = 0.15
"""In seconds: this machine may be busy."""

INSTANCE, ROBOT = "10.78.0.2", "10.78.0.1"

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
]


@pytest.fixture
def instance(dds: None, monkeypatch: pytest.MonkeyPatch, lan: Network) -> list[str]:
    """The instance's host."""
    return lan.host(INSTANCE)


@pytest.fixture
def lan(dds: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    pytest.importorskip("rclpy")
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as made:
        yield made


@pytest.fixture
def robot(lan: Network, processes: Processes, tmp_path: Path) -> subprocess.Popen[str]:
    robots = settings(tmp_path, "robot", profiles_xml(OUTPUTS))
    return processes.node("receive", inside=lan.host(ROBOT), script="commands.py", **robots)


def settings(folder: Path, name: str, text: str) -> dict[str, str]:
    file = folder / f"{name}.xml"
    file.write_text(text)
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}


def arrived(robot: subprocess.Popen[str]) -> dict[str, list[float]]:
    """End the robot, and return the ages of the commands that arrived, by output."""
    robot.kill()
    ages: dict[str, list[float]] = defaultdict(list)
    while line := Processes.line(robot, 30):
        output, age = line.split()
        ages[output].append(float(age))
    return ages


def test_commands_that_were_sent_behind_a_closed_gate_do_not_arrive_when_it_opens(
    instance: list[str], robot: subprocess.Popen[str], processes: Processes, tmp_path: Path
) -> None:
    fence(instance, True)
    instances = settings(tmp_path, "instance", instance_profiles_xml([], OUTPUTS))
    processes.node("send", inside=instance, script="commands.py", **instances)
    time.sleep(6)
    fence(instance, False)
    time.sleep(5)
    ages = arrived(robot)
    assert all(len(ages[output.name]) > 5 for output in OUTPUTS), "each output reaches the robot through an open gate"
    oldest = {output.name: max(ages[output.name]) for output in OUTPUTS}
    assert {name: age for name, age in oldest.items() if age > LIFESPANS[name] + MARGIN} == {}


def test_a_call_that_is_lost_once_still_arrives_within_its_lifespan(
    instance: list[str], robot: subprocess.Popen[str], processes: Processes, tmp_path: Path
) -> None:
    instances = settings(tmp_path, "instance", instance_profiles_xml([], OUTPUTS))
    sender = processes.node("once", inside=instance, script="commands.py", **instances)
    assert sender.stdin is not None

    def call() -> None:
        sender.stdin.write("now\n")
        sender.stdin.flush()

    fence(instance, True)
    call()
    time.sleep(0.15)
    fence(instance, False)
    time.sleep(1.2)
    call()  # announces to the reader what it missed, which has expired by now
    time.sleep(0.5)
    ages = arrived(robot)
    for output in (SERVICE, ACTION):
        assert len(ages[output]) >= 3, "the first one, the one that was lost, and the last one"
        assert 0.15 < max(ages[output]) < LIFESPANS[output] + MARGIN
