"""What publishers offer stands in recordings as rosbag2 writes it: rosbags, which reads and writes the same files, is asked."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("rclpy")

import yaml
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, qos_profile_sensor_data
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from std_msgs.msg import String

from tests.unit.dds import isolate_discovery
from understudy.ros.observe.offered_qos import offers
from understudy.ros.runtime.graph_node import Graph

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EXACTING = QoSProfile(
    depth=5, deadline=Duration(seconds=1, nanoseconds=250_000_000), lifespan=Duration(seconds=2),
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC, liveliness_lease_duration=Duration(seconds=3),
)  # fmt: skip
PROFILES = [QoSProfile(depth=10), LATCHED, qos_profile_sensor_data, EXACTING]


def test_another_implementation_reads_and_writes_the_same_qos() -> None:
    text = offers(PROFILES)
    assert dump_qos_v9(parse_qos(text)) == yaml.safe_load(text)
    read = parse_qos(text)
    assert [(one.reliability.name, one.durability.name, one.depth) for one in read] == [
        ("RELIABLE", "VOLATILE", 10), ("RELIABLE", "TRANSIENT_LOCAL", 1), ("BEST_EFFORT", "VOLATILE", 5), ("RELIABLE", "VOLATILE", 5),
    ]  # fmt: skip
    assert [(one.sec, one.nsec) for one in (read[3].deadline, read[3].lifespan)] == [(1, 250_000_000), (2, 0)]
    assert read[3].liveliness.name == "MANUAL_BY_TOPIC"


def test_publishers_with_the_same_qos_are_reported_once() -> None:
    assert len(yaml.safe_load(offers([QoSProfile(depth=10), LATCHED, QoSProfile(depth=10)]))) == 2


def test_a_topic_without_publishers_has_an_empty_list() -> None:
    assert yaml.safe_load(offers([])) == [], "a list, where rosbag2 stumbles over nothing at all"


def test_discovered_qos_is_written_as_rosbag2_does(monkeypatch: pytest.MonkeyPatch) -> None:
    isolate_discovery(monkeypatch)
    graph = Graph("looks")
    publisher = graph.node.create_publisher(String, "/said", LATCHED)
    end = time.monotonic() + 20
    while not graph.offers("/said"):
        assert time.monotonic() < end
        time.sleep(0.01)
    (profile,) = yaml.safe_load(offers(qos for _, qos in graph.offers("/said")))
    graph.node.destroy_publisher(publisher)
    graph.close()
    for_ever = {"sec": Infinite.nanoseconds // 10**9, "nsec": Infinite.nanoseconds % 10**9}
    assert profile == {
        "history": "unknown", "depth": 0,  # which isn't announced
        "reliability": "reliable", "durability": "transient_local", "deadline": for_ever,
        "lifespan": for_ever, "liveliness": "automatic", "liveliness_lease_duration": for_ever,
        "avoid_ros_namespace_conventions": False,
    }  # fmt: skip
