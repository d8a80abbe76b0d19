"""The real ROS graph shows whether a node exists; its address decides whether it counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.ros.dds.host_ids import HOST, VENDOR, host_id
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.trees.core.health_tree import WatchedTopic

pytestmark = pytest.mark.ros

WANTED = WatchedTopic("/controller", None, 0.0, None, subscribed=False, node=True)


@pytest.fixture
def join(dds: None) -> Iterator[Callable[[str], Graph]]:
    """Nodes more, each a participant of its own."""
    made: list[Graph] = []

    def join(name: str) -> Graph:
        made.append(Graph(name))
        return made[-1]

    yield join
    for graph in made:
        graph.close()


def test_a_missing_node_fails_regardless_of_other_nodes(watching, join, eventually, graph):
    judged = Judged(watching, {"node": {"name": "/controller", "for": "300ms"}})
    teleop = join("teleop")
    eventually(lambda: judged.now() and any(end.node == "/teleop" for end in graph.publishers("/parameter_events")))
    assert judged.now().state == "Starting", "others don't count"
    controller = join("controller")
    eventually(lambda: judged.now().state == "Healthy")
    teleop.close()
    states = set()

    def gone() -> bool:
        states.add(judged.now().state)
        return not any(end.node == "/teleop" for end in graph.publishers("/parameter_events"))

    eventually(gone)
    assert states == {"Healthy"}
    controller.close()
    assert judged.until_failed().reason == "node /controller has been missing for 300 ms"
    join("controller")
    eventually(lambda: judged.now().state == "Healthy")


def test_a_node_without_parameter_events_is_found_by_its_other_endpoints(watching, join, eventually, graph):
    # Its other topics are gone through once a second.
    controller, judged = join("controller"), Judged(watching, {"node": {"name": "/controller", "for": "5s"}})
    eventually(lambda: judged.now().state == "Healthy")
    node = controller.node
    listener = controller.subscribe("/chat", "std_msgs/msg/String", depth=1)
    node.destroy_publisher(next(p for p in node.publishers if p.topic_name == "/parameter_events"))
    states = set()

    def without() -> bool:
        states.add(judged.now().state)
        return not any(end.node == "/controller" for end in graph.publishers("/parameter_events"))

    eventually(without)
    for _ in range(3):
        watching.follow(judged.tree.topics)  # so that it looks again at once
        states.add(judged.now().state)
    assert states == {"Healthy"}
    controller.unsubscribe(listener)
    eventually(lambda: judged.now().state == "Failed")


def test_an_agent_counts_only_nodes_of_its_own_host(graph, join, eventually):
    join("controller")
    eventually(lambda: any(end.node == "/controller" for end in graph.publishers("/parameter_events")))
    (host,) = {end.gid[HOST] for end in graph.publishers("/parameter_events") if end.node == "/controller"}
    for own, expected in ((host, True), (VENDOR + b"xx", False)):
        watching = TopicWatch(graph, own)
        watching.follow([WANTED])
        watching.drain()
        assert (watching.node("/controller").there, watching.node("/controller").elsewhere) == (expected, True)
        watching.close()


def test_the_monitor_counts_only_nodes_of_the_active_instance_and_the_robot(watching, monkeypatch, graph):
    active, standby, robot = "192.0.2.1", "192.0.2.2", "192.0.2.3"
    ends: list[Endpoint] = []

    def give(*nodes: tuple[str, str]) -> None:
        ends[:] = [Endpoint("any", VENDOR + host_id(address) + bytes(12), node) for address, node in nodes]

    monkeypatch.setattr(graph, "publishers", lambda topic: ends)
    monkeypatch.setattr(graph, "publisher_count", lambda topic: len(ends))
    watching.follow([WANTED])

    def counted(instances: dict[str, str], pod: str) -> Any:
        watching.attribute(instances, pod)
        assert watching.node("/controller") is None, "what was seen was of others"
        watching.drain()
        return watching.node("/controller").there, watching.node("/controller").elsewhere

    give((active, "/controller"), (standby, "/controller"), (robot, "/driver"))
    assert counted({"w-1": active, "w-2": standby}, "w-1") == (True, True)
    assert counted({"w-1": active, "w-2": standby}, "w-2") == (True, True)
    assert counted({"w-1": active, "w-2": standby}, "") == (False, True)
    give((standby, "/controller"), (active, "/driver"))
    assert counted({"w-1": active, "w-2": standby}, "w-1") == (False, True)
    give((robot, "/controller"))
    assert counted({"w-1": "2001:db8::1", "w-2": standby}, "w-1") == (True, True), "that address tells nothing"
    give()
    assert counted({"w-1": active, "w-2": standby}, "w-1") == (False, False)


def test_publishers_are_searched_when_their_number_changes_and_otherwise_rarely(
    watching, monkeypatch, eventually, graph
):
    looks = []
    real = graph.publishers
    eventually(lambda: (ends := real("/parameter_events")) and all(end.node for end in ends))
    monkeypatch.setattr(graph, "publishers", lambda topic: looks.append(topic) or real(topic))
    monkeypatch.setattr("understudy.ros.observe.graph_presence.AT_LEAST", 3600.0)
    watching.follow([WANTED])
    eventually(lambda: watching.drain() or watching.node("/controller"))
    looks.clear()
    first = watching.node("/controller").received
    eventually(lambda: watching.drain() or watching.node("/controller").received > first + 0.3)
    assert not looks, "nothing has changed"
    extra = Graph("controller")
    try:
        eventually(lambda: watching.drain() or watching.node("/controller").there)
        assert looks
    finally:
        extra.close()
