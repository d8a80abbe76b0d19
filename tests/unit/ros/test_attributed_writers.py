"""Samples are attributed by their writers, if these are known, although both have one address."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy")

from rclpy.qos import QoSProfile
from std_msgs.msg import String

from understudy.ros.observe.sample_rings import SampleRing
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.health_tree import WatchedTopic

pytestmark = pytest.mark.ros

CHAT = "/chat"


@pytest.fixture
def graph(dds: None) -> Iterator[Graph]:
    found = Graph("watching")
    yield found
    found.close()


def test_two_instances_with_one_address_are_told_apart_by_their_writers(graph: Graph) -> None:
    watching = TopicWatch(graph)
    watching.follow([WatchedTopic(CHAT, "std_msgs/msg/String", 10.0, None)])
    first, second = (graph.node.create_publisher(String, CHAT, QoSProfile(depth=10)) for _ in range(2))
    end = time.monotonic() + 20
    while len(graph.publishers(CHAT)) < 2:
        assert time.monotonic() < end
        time.sleep(0.05)
    one, other = (writer.gid for writer in graph.publishers(CHAT))
    watching.attribute_writers({one: "w-1", other: "w-2"})
    watching.attribute({}, "w-1")
    ring = SampleRing(60.0, 1_000_000)
    watching.record(ring, only_counted=True)
    while not (watching.arrivals(CHAT, "w-1") and watching.arrivals(CHAT, "w-2")):
        assert time.monotonic() < end
        first.publish(String(data="x"))
        second.publish(String(data="x"))
        time.sleep(0.05)
        watching.drain()
    counted, own = watching.topic(CHAT), watching.arrivals(CHAT, "w-1")
    assert counted is not None
    assert list(counted.arrivals) == list(own), "only those of the active one count"
    last = watching.last_from_others(CHAT, "w-1")
    assert last is not None
    assert last[1] == "w-2"
    (recorded,) = ring.taken(0.0)
    assert [received for received, *_ in recorded.messages] == list(own), "the robot receives nobody else"


def test_what_was_received_before_a_writer_was_known_stays_with_its_instance(graph: Graph) -> None:
    watching = TopicWatch(graph)
    watching.follow([WatchedTopic(CHAT, "std_msgs/msg/String", 10.0, None)])
    watching.attribute({"w-1": "127.0.0.1"}, "w-1")
    publisher, end = graph.node.create_publisher(String, CHAT, QoSProfile(depth=10)), time.monotonic() + 20
    while not watching.records(CHAT):
        assert time.monotonic() < end
        publisher.publish(String(data="x"))
        time.sleep(0.05)
        watching.drain()
    before = len(watching.records(CHAT))
    (writer,) = (found.gid for found in graph.publishers(CHAT))
    (received,) = (len(record.arrivals) for record in watching.records(CHAT).values())
    watching.attribute_writers({writer: "w-1"})
    assert len(watching.records(CHAT)) == before == 1
    assert len(watching.arrivals(CHAT, "w-1")) == received
