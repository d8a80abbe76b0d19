"""Looking who reads the outputs costs little, and never disturbs the monitor: it says where it could not tell."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy")

from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenGraph, GivenObserver
from understudy.api.conditions import condition
from understudy.api.kinds.robot_workload import Output
from understudy.monitor.notices import PublishedStatus
from understudy.monitor.observe.robot import robot_readers
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.ros.runtime.graph_node import Endpoint, Graph

CMD_VEL = Output(topic="/cmd_vel", type="geometry_msgs/msg/Twist")
READER = Endpoint("geometry_msgs/msg/Twist", bytes(15) + b"\x04", "/base")


class Server(GivenGraph):
    """A discovery server that never answers, and a graph of readers of which it doesn't tell."""

    def __init__(self) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"

    def asked(self) -> bool:
        """Whether somebody has since the last time."""
        found = False
        with contextlib.suppress(BlockingIOError):
            while self._socket.recv(2000):
                found = True
        return found

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    made = Server()
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", made.address)
    monkeypatch.setattr(robot_readers, "WITHIN", 0.05)
    monkeypatch.setattr(robot_readers, "SETTLE", 0.0)
    yield made
    made.close()


def looking(graph: Graph, notices: RecordedNotices, outputs: list[Output]) -> RobotReaders:
    objects, observer = ClusterObjects(workload="robot-17", notices=notices), GivenObserver()
    objects.put_workload(outputs=[output.to_wire() for output in outputs])
    observer.graph = graph
    return RobotReaders(objects.view, observer, notices, "127.0.0.1")


def looks(one: RobotReaders, times: int) -> None:
    async def look() -> None:
        for _ in range(times):
            await one.check()

    asyncio.run(look())


def test_discovery_is_asked_once_for_a_reader_and_a_missing_answer_is_reported(server: Server) -> None:
    notices = RecordedNotices()
    one = looking(server, notices, [CMD_VEL])
    looks(one, 2)
    assert not server.asked(), "where nobody reads there is nothing to ask"
    assert notices.conditions["OutputsRead"][:2] == ("Unknown", "NobodyReads")
    server.readers["/cmd_vel"] = [READER]
    looks(one, 2)
    assert server.asked()
    assert notices.conditions["OutputsRead"][:2] == ("Unknown", "ReadersUnknown")
    looks(one, 3)
    assert not server.asked()
    server.readers["/cmd_vel"] = [READER, Endpoint(READER.type, bytes(14) + b"\x01\x04", "/other")]
    looks(one, 1)
    assert server.asked(), "another one is asked for at once"


def test_a_finding_is_reported_only_after_it_has_lasted(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_readers, "SETTLE", 60.0)
    notices = RecordedNotices()
    looks(looking(server, notices, [CMD_VEL]), 3)
    assert notices.conditions == {}


def test_the_finding_of_an_earlier_monitor_is_kept_until_there_is_a_new_one(server: Server) -> None:
    earlier = condition("OutputsRead", False, "ReaderWithoutProfile", "The gate doesn't reach it.")
    notices = RecordedNotices(PublishedStatus(by_type={earlier.type: earlier}))
    one = looking(server, notices, [CMD_VEL])
    assert one.ungated == "The gate doesn't reach it."
    looks(one, 2)
    assert one.ungated == ""


def test_a_workload_without_topics_has_no_condition_about_readers(server: Server) -> None:
    notices = RecordedNotices()
    notices.condition("OutputsRead", "Unknown", "NobodyReads")
    looks(looking(server, notices, [Output(service="/snap", type="std_srvs/srv/Trigger")]), 2)
    assert notices.conditions == {}


def test_an_unavailable_discovery_server_makes_readers_unknown(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "not a port:eleven")
    notices = RecordedNotices()
    server.readers["/cmd_vel"] = [READER]
    looks(looking(server, notices, [CMD_VEL]), 2)
    assert notices.conditions["OutputsRead"][:2] == ("Unknown", "ReadersUnknown")


def test_an_error_does_not_end_the_observation(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_readers, "AGAIN", 0.01)
    monkeypatch.setattr(robot_readers, "PERIOD", 0.01)

    class Broken(GivenGraph):
        looked = 0

        def subscribers(self, topic: str) -> list[Endpoint]:
            self.looked += 1
            raise RuntimeError("the graph is being closed")

    notices, graph = RecordedNotices(), Broken()
    one = looking(graph, notices, [CMD_VEL])

    async def run() -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(one.run(), 0.5)

    asyncio.run(run())
    assert graph.looked > 1
    assert notices.conditions["OutputsRead"][:2] == ("Unknown", "ReadersUnknown")
