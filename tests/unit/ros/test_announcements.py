"""DDS discovery reports where readers listen and in which partitions writers are: asked of real Fast DDS, with and without a server."""

from __future__ import annotations

import asyncio
import json
import os
import socket

import pytest

pytest.importorskip("rclpy")

from tests.support.network_namespaces import network
from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.ros.dds.endpoint_announcements import Discovery, locators
from understudy.ros.dds.profiles import profiles_xml
from understudy.ros.middleware import Locator

pytestmark = pytest.mark.ros

CHAT = "/chat"

IN_A_PARTITION = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com"><profiles>
  <data_writer profile_name="/chat">
    <qos><partition><names><name>understudy-${POD}</name><name>second</name></names></partition></qos>
  </data_writer>
</profiles></dds>
"""


@pytest.fixture
def profiles(dds, tmp_path):
    """What makes a process one whose reader has a gated port."""
    file = tmp_path / "profiles.xml"
    file.write_text(profiles_xml([Output(topic=CHAT, type="std_msgs/msg/String")]))
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}


ASK = """
import asyncio, json, os, sys, time
from understudy.ros.dds.endpoint_announcements import Discovery, locators
from understudy.ros.runtime.graph_node import Graph

def ask(gids, within):
    found = asyncio.run(locators(gids, sys.argv[1], Discovery.of(os.environ), within=within))
    return sorted([[place.address, place.port] for place in places] for places in found.values())

graph = Graph("monitor")
print("ready", flush=True)
while len(readers := graph.subscribers("/chat")) < 2:
    time.sleep(0.05)
gids = [reader.gid for reader in readers]
begun = time.monotonic()
first, took = ask(gids, 5.0), time.monotonic() - begun
again, some = ask(gids, 5.0), ask([gids[0], bytes(16)], 1.5)
told = {"first": first, "took": took, "again": again, "some": some, "readers": len(graph.subscribers("/chat"))}
print(json.dumps(told), flush=True)
"""


@pytest.fixture
def script(tmp_path):
    """Asks from a process of its own: this one's Fast DDS would never again do without the server."""
    file = tmp_path / "ask.py"
    file.write_text(ASK)
    return str(file)


def test_a_discovery_server_reports_every_reader_and_forgets_the_requester(
    discovery_server, processes, profiles, script
) -> None:
    discovery_server()
    processes.node("obey", CHAT, "{}")
    processes.node("obey", CHAT, "{}", **profiles)
    announced = json.loads(processes.line(processes.node("127.0.0.1", script=script), 60))
    assert announced["took"] < 5, "it left as soon as it knew"
    gated, plain = sorted(announced["first"])
    assert [port for _, port in gated] == [names.GATE_PORTS[0]] * len(gated)
    assert all(port > names.GATE_RANGE[1] for _, port in plain)
    assert announced["again"] == announced["first"], "it can be asked again, in another's name"
    assert len(announced["some"]) == 1, "one that isn't there keeps it from nothing"
    assert announced["readers"] == 2


ASK_WRITERS = """
import asyncio, json, os, sys, time
from understudy.ros.dds.endpoint_announcements import Discovery, partitions
from understudy.ros.runtime.graph_node import Graph

graph = Graph("mux")
print("ready", flush=True)
while len(writers := graph.publishers("/chat")) < 2:
    time.sleep(0.05)
gids = [writer.gid for writer in writers]
found = asyncio.run(partitions(gids, sys.argv[1], Discovery.of(os.environ), within=5.0))
print(json.dumps(sorted(found.values())), flush=True)
"""


@pytest.fixture
def partitioned(tmp_path):
    """What puts the writer of a process in a partition."""
    file = tmp_path / "partition.xml"
    file.write_text(IN_A_PARTITION)
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file), "POD": "pod-a"}


@pytest.fixture
def writers_script(tmp_path):
    file = tmp_path / "ask_writers.py"
    file.write_text(ASK_WRITERS)
    return str(file)


def test_a_discovery_server_reports_the_partitions_of_each_writer(
    discovery_server, processes, partitioned, writers_script
) -> None:
    discovery_server()
    processes.node("publish", CHAT, "5")
    processes.node("publish", CHAT, "5", **partitioned)
    asker = processes.node("127.0.0.1", script=writers_script)
    assert json.loads(processes.line(asker, 60)) == [[], ["understudy-pod-a", "second"]]


def test_without_an_answer_the_known_locators_are_returned() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        discovery = Discovery("127.0.0.1", silent.getsockname()[1], b"DS\0_EPROSIMA")
        assert asyncio.run(locators([bytes(16)], "127.0.0.1", discovery, within=0.8)) == {}
        silent.setblocking(False)
        readers: list[int] = []
        while len(readers) < 4:
            try:
                readers.append(silent.recvfrom(2000)[1][1])
            except BlockingIOError:
                break
    assert len(readers) == 3, "two announcements, for one may be lost, and a farewell"
    assert all(7410 < port < 7650 for port in readers), "from a port that the domain's firewalls let through"


def test_the_requested_discovery_follows_the_ros_environment() -> None:
    assert Discovery.of({"ROS_DISCOVERY_SERVER": "10.0.0.7:11811"}) == Discovery("10.0.0.7", 11811, b"DS\0_EPROSIMA")
    assert Discovery.of({"ROS_DOMAIN_ID": "17"}) == Discovery("239.255.0.1", 11650, domain=17)
    assert Discovery.of({}).port == 7400
    local = Discovery.of({"ROS_DOMAIN_ID": "17", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    assert local.host == "127.0.0.1"
    assert (local.ports[0], local.ports[1], len(local.ports)) == (11660, 11662, 32), "as rmw_fastrtps asks"


def test_on_one_host_each_participant_reports_the_partitions_of_its_writers(
    processes, partitioned, writers_script
) -> None:
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    processes.node("publish", CHAT, "5")
    processes.node("publish", CHAT, "5", **partitioned)
    asker = processes.node("127.0.0.1", script=writers_script)
    assert json.loads(processes.line(asker, 60)) == [[], ["understudy-pod-a", "second"]]


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


@needs_root
def test_without_a_server_each_participant_reports_its_own_readers(processes, profiles, script, monkeypatch) -> None:
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as lan:
        processes.node("obey", CHAT, "{}", inside=lan.host("10.77.0.2"))
        processes.node("obey", CHAT, "{}", inside=lan.host("10.77.0.3"), **profiles)
        asker = processes.node("10.77.0.4", inside=lan.host("10.77.0.4"), script=script)
        announced = json.loads(processes.line(asker, 60))
    (plain,), (gated,) = ([Locator(*place) for place in places] for places in announced["first"])
    assert plain.address == "10.77.0.2"
    assert plain.port > names.GATE_RANGE[1]
    assert gated == Locator("10.77.0.3", names.GATE_PORTS[0])


@needs_root
def test_without_a_server_each_participant_reports_the_partitions_of_its_writers(
    processes, partitioned, writers_script, monkeypatch
) -> None:
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as lan:
        processes.node("publish", CHAT, "5", inside=lan.host("10.77.0.2"))
        processes.node("publish", CHAT, "5", inside=lan.host("10.77.0.3"), **partitioned)
        asker = processes.node("10.77.0.4", inside=lan.host("10.77.0.4"), script=writers_script)
        assert json.loads(processes.line(asker, 60)) == [[], ["understudy-pod-a", "second"]]
