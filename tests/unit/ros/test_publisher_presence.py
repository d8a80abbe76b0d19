"""The real ROS graph shows who publishes a topic; the address of a publisher decides whether it counts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.clock import set_clock
from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.ros.dds.host_ids import HOST, VENDOR, host_id
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.trees.core.health_tree import WatchedTopic

pytestmark = pytest.mark.ros


@pytest.fixture
def others(dds: None) -> Iterator[tuple[Graph, Graph]]:
    """Two nodes more."""
    made = Graph("controller"), Graph("teleop")
    yield made
    for graph in made:
        graph.close()


def publisher(graph: Graph, topic: str) -> Any:
    from std_msgs.msg import String

    return graph.node.create_publisher(String, topic, 1)


def test_a_missing_publisher_fails_regardless_of_other_publishers(watching, others, eventually):
    controller, teleop = others
    judged = Judged(watching, {"publisher": {"topic": "/chat", "node": "/controller", "for": "300ms"}})
    publisher(teleop, "/chat")
    eventually(lambda: judged.now() and "/teleop" in watching.publishers("/chat").nodes)
    assert judged.now().state == "Starting", "others don't count"
    own = publisher(controller, "/chat")
    eventually(lambda: judged.now().state == "Healthy")
    controller.node.destroy_publisher(own)
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "/chat", "/controller", "300 ms", "no publisher")
    publisher(controller, "/chat")
    eventually(lambda: judged.now().state == "Healthy")


def test_other_publishers_subscribers_and_topics_have_no_influence(watching, others, eventually, graph):
    controller, teleop = others
    judged = Judged(watching, {"publisher": {"topic": "/chat", "count": 1}})
    publisher(controller, "/chat")
    passing, beside = publisher(teleop, "/chat"), publisher(controller, "/talk")
    listener = teleop.subscribe("/chat", "std_msgs/msg/String", depth=1)
    eventually(lambda: judged.now().state == "Healthy" and len(watching.publishers("/chat").nodes) == 2)
    teleop.node.destroy_publisher(passing)
    teleop.unsubscribe(listener)
    controller.node.destroy_publisher(beside)
    states = set()

    def gone() -> bool:
        states.add(judged.now().state)
        return len(watching.publishers("/chat").nodes) == 1 and not graph.publishers("/talk")

    eventually(gone)
    assert states == {"Healthy"}


def test_the_leaf_does_not_subscribe_to_the_topic(watching, others, eventually, graph):
    judged = Judged(watching, {"publisher": {"topic": "/chat"}})
    publisher(others[0], "/chat")
    eventually(lambda: judged.now().state == "Healthy")
    assert watching.topic("/chat") is None
    assert not graph.subscribers("/chat")
    assert watching.waiting == watching.problems == []
    watching.follow([])
    assert watching.publishers("/chat") is None


def test_an_agent_counts_only_publishers_of_its_own_host(graph, others, eventually):
    publisher(others[0], "/chat")
    eventually(lambda: graph.publishers("/chat"))
    (host,) = {endpoint.gid[HOST] for endpoint in graph.publishers("/chat")}
    for own, expected in ((host, 1), (VENDOR + b"xx", 0)):
        watching = TopicWatch(graph, own)
        watching.follow([WatchedTopic("/chat", None, 0.0, None, subscribed=False, publishers=True)])
        watching.drain()
        assert len(watching.publishers("/chat").nodes) == expected
        watching.close()


def test_the_monitor_counts_only_publishers_of_the_active_instance_or_the_robot(watching, monkeypatch, graph):
    def gid(address: str) -> bytes:
        return VENDOR + host_id(address) + bytes(12)

    active, standby, robot = "192.0.2.1", "192.0.2.2", "192.0.2.3"
    ends = [
        Endpoint("std_msgs/msg/String", gid(address), node)
        for address, node in ((active, "/a"), (standby, "/b"), (robot, "/c"))
    ]
    monkeypatch.setattr(graph, "publishers", lambda topic: ends)
    watching.follow([WatchedTopic("/chat", None, 0.0, None, subscribed=False, publishers=True)])

    def counted(instances: dict[str, str], pod: str) -> tuple[str, ...]:
        watching.attribute(instances, pod)
        assert watching.publishers("/chat") is None, "what was seen was of others"
        watching.drain()
        return watching.publishers("/chat").nodes

    assert counted({"w-1": active, "w-2": standby}, "w-1") == ("/a",)
    assert counted({"w-1": active, "w-2": standby}, "w-2") == ("/b",)
    assert counted({"w-1": active, "w-2": standby}, "") == ("/c",)
    assert counted({"w-1": "2001:db8::1", "w-2": standby}, "w-1") == ("/a", "/c"), "that address tells nothing"


def test_a_clock_step_moves_the_times_of_observations(watching, others, eventually, monkeypatch):
    judged = Judged(watching, {"publisher": {"topic": "/chat"}})
    publisher(others[0], "/chat")
    eventually(lambda: judged.now().state == "Healthy")
    publishers = watching.publishers("/chat")
    before = publishers.received

    set_clock(monkeypatch, 3600.0)
    watching.drain()
    assert publishers.received - before == pytest.approx(3600.0, abs=1.0)
