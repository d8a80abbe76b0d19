"""The reflex on real DDS: the robot's reader switches by itself, and an instance that is fenced or late does not come back."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.support.network_namespaces import Network, fence, network
from tests.unit.ros.processes import Processes
from understudy.agent.prepare import filled_in
from understudy.agent.writer_strength import WriterStrengths
from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex
from understudy.ros.dds.profiles import gate_ports, instance_profiles_xml, profiles_xml

REFLEX = Reflex(deadline="300ms")
CHAT = Output(topic="/chat", type="std_msgs/msg/String")
SNAP = Output(service="/snap", type="std_srvs/srv/Trigger")
SPACE = {"d": "http://www.eprosima.com"}
PODS = {"primary": "10.77.0.2", "fallback": "10.77.0.3"}


# -- the files -----------------------------------------------------------------------------------------------------


def deadline(endpoint: ElementTree.Element) -> float | None:
    period = endpoint.find("d:qos/d:deadline/d:period", SPACE)
    if period is None:
        return None
    return int(period.findtext("d:sec", "", SPACE)) + int(period.findtext("d:nanosec", "", SPACE)) / 1e9


def test_the_deadline_of_writers_is_slightly_shorter_than_that_of_robot_readers() -> None:
    for text in ("20ms", "100ms", "333ms", "1s", "9.99s"):
        reflex = Reflex(deadline=text)
        reader = ElementTree.fromstring(profiles_xml([CHAT], reflex)).find(".//d:data_reader", SPACE)
        writer = ElementTree.fromstring(instance_profiles_xml([], [CHAT], reflex)).find(".//d:data_writer", SPACE)
        assert reader is not None
        assert writer is not None
        asked, offered = deadline(reader), deadline(writer)
        assert asked is not None
        assert offered is not None
        assert 0.85 * asked < offered < asked, "a writer that offers a longer deadline isn't matched"
        for endpoint in (reader, writer):
            assert endpoint.findtext("d:qos/d:ownership/d:kind", "", SPACE) == "EXCLUSIVE"


def test_with_the_reflex_every_reader_keeps_its_gate_port() -> None:
    root = ElementTree.fromstring(profiles_xml([CHAT, SNAP], REFLEX))
    ports = {
        reader.attrib["profile_name"]: int(reader.findtext(".//d:port", "", SPACE))
        for reader in root.iterfind(".//d:data_reader", SPACE)
    }
    assert ports == gate_ports([CHAT, SNAP])
    owned = [r.attrib["profile_name"] for r in root.iterfind(".//d:data_reader", SPACE) if deadline(r) is not None]
    assert owned == ["/chat"], "services have no owner"


def test_the_readers_of_an_instance_match_its_writers_and_have_no_deadline() -> None:
    root = ElementTree.fromstring(instance_profiles_xml([], [CHAT, SNAP], REFLEX))
    (reader,) = root.iterfind(".//d:data_reader", SPACE)
    assert reader.attrib["profile_name"] == "/chat"
    assert reader.findtext("d:qos/d:ownership/d:kind", "", SPACE) == "EXCLUSIVE"
    assert deadline(reader) is None


def test_without_the_reflex_there_is_no_ownership() -> None:
    assert "ownership" not in profiles_xml([CHAT]) + instance_profiles_xml([], [CHAT])


# -- real nodes ----------------------------------------------------------------------------------------------------


def profile(directory: Path, name: str, text: str, strength: int = 0) -> str:
    folder = directory / name
    folder.mkdir(exist_ok=True)
    file = folder / names.PROFILES_KEY
    file.write_text(filled_in(text, {names.STRENGTH_VARIABLE: str(strength), names.POD_VARIABLE: name}))
    return str(file)


@pytest.fixture
def lan(dds: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as made:
        yield made


def until_from(robot: subprocess.Popen[str], pod: str, count: int = 20, within: float = 40.0) -> None:
    """Wait until so many samples in a row are from a pod."""
    end, row = time.monotonic() + within, 0
    while row < count:
        assert time.monotonic() < end, f"{within} s were not enough to hear {count} in a row of {pod}"
        row = row + 1 if Processes.line(robot, within) == pod else 0


def senders(robot: subprocess.Popen[str], count: int) -> set[str]:
    """The senders of the next samples."""
    return {Processes.line(robot, 40) for _ in range(count)}


@pytest.mark.ros
@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
def test_a_robot_reader_switches_to_the_standby_and_never_returns_to_the_loser(
    lan: Network, processes: Processes, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    robots = profile(tmp_path, "robot", profiles_xml([CHAT], REFLEX))
    instances = instance_profiles_xml([], [CHAT], REFLEX)
    primary, fallback = (lan.host(ip) for ip in PODS.values())
    robot = processes.node(
        "obey", "/chat", json.dumps(PODS), inside=lan.host("10.77.0.1"), FASTRTPS_DEFAULT_PROFILES_FILE=robots
    )
    weak = profile(tmp_path, "fallback", instances, strength=4_000_000_001)
    processes.node("publish", "/chat", "20", inside=fallback, FASTRTPS_DEFAULT_PROFILES_FILE=weak)
    until_from(robot, "fallback")
    strong = profile(tmp_path, "primary", instances, strength=4_000_000_002)
    first = processes.node("publish", "/chat", "20", inside=primary, FASTRTPS_DEFAULT_PROFILES_FILE=strong)
    until_from(robot, "primary")

    # Frozen: the reader falls over; fenced meanwhile, it doesn't come back when it goes on.
    first.send_signal(signal.SIGSTOP)
    until_from(robot, "fallback")
    fence(primary, True)
    first.send_signal(signal.SIGCONT)
    assert senders(robot, 40) == {"fallback"}

    # Not fenced, the stronger one would: that's why there must be a commit.
    fence(primary, False)
    until_from(robot, "primary")

    # It is killed, and restarted after the request to give way: readers do not accept it, even without a fence.
    first.kill()
    until_from(robot, "fallback")
    WriterStrengths(Path(strong).parent).give_way()
    processes.node("publish", "/chat", "20", inside=primary, FASTRTPS_DEFAULT_PROFILES_FILE=strong)
    assert senders(robot, 60) == {"fallback"}
