"""The state of topics is taken as bytes: what was said before, of whom, and until when it holds."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.support.network_namespaces import Network, network
from tests.unit.ros.processes import Processes
from understudy.ros.observe.state_samples import Captured, StateSamples
from understudy.ros.runtime.graph_node import Graph

pytestmark = pytest.mark.ros

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


@pytest.fixture
def capturing(graph: Graph) -> Iterator[StateSamples]:
    made = StateSamples(graph)
    yield made
    made.close()


@pytest.fixture
def took(capturing: StateSamples, eventually: Callable[..., None]) -> Callable[[str], Captured]:
    """Wait for a message of a topic."""

    def wait(topic: str) -> Captured:
        found: list[Captured] = []
        eventually(lambda: [found.append(m) for m in capturing.drain() if m.topic == topic] and found)
        return found[-1]

    return wait


def x(message: Captured) -> float:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.serialization import deserialize_message

    return float(deserialize_message(message.data, PoseWithCovarianceStamped).pose.pose.position.x)


def test_a_latched_message_is_captured_with_its_own_time(
    capturing: StateSamples, processes: Processes, took: Callable[[str], Captured]
) -> None:
    before = time.time()
    processes.node("pose", "/amcl_pose", "1.5", "0", "latched")
    stamp = time.time()
    time.sleep(1.0)
    capturing.follow({"/amcl_pose": POSE})
    message = took("/amcl_pose")
    assert (x(message), message.type, message.standing) == (1.5, POSE, "robot")
    assert before <= message.taken_at <= stamp, "its age is that of the message, not of the subscription"
    assert message.received_at >= stamp + 1.0


def test_a_later_publisher_is_captured_with_and_without_latching(
    capturing: StateSamples, processes: Processes, took: Callable[[str], Captured]
) -> None:
    capturing.follow({"/amcl_pose": POSE, "/odom": POSE})
    assert capturing.waiting == {"/amcl_pose": "nobody publishes it", "/odom": "nobody publishes it"}
    processes.node("pose", "/amcl_pose", "2.5", "0", "latched")
    processes.node("pose", "/odom", "3.5", "20")
    assert x(took("/amcl_pose")) == 2.5
    message = took("/odom")
    assert (x(message), message.standing) == (3.5, "")
    assert message.taken_at == message.received_at
    end = time.monotonic() + 20
    while capturing.waiting and time.monotonic() < end:  # what is said is looked up now and then
        capturing.follow({"/amcl_pose": POSE, "/odom": POSE})
        capturing.drain()
        time.sleep(0.05)
    assert capturing.waiting == capturing.problems == {}


def test_the_type_is_read_from_the_graph(
    capturing: StateSamples, processes: Processes, took: Callable[[str], Captured]
) -> None:
    capturing.follow({"/amcl_pose": None})
    assert capturing.waiting == {"/amcl_pose": "nobody publishes it, so its type is not known"}
    processes.node("pose", "/amcl_pose", "1.0", "0", "latched")
    assert took("/amcl_pose").type == POSE


def test_only_the_last_of_many_messages_is_captured(
    capturing: StateSamples, processes: Processes, took: Callable[[str], Captured]
) -> None:
    capturing.follow({"/odom": POSE})
    processes.node("pose", "/odom", "1.0", "100")
    took("/odom")
    time.sleep(0.5)
    assert len(capturing.drain()) <= 1


def test_a_type_that_is_not_installed_is_reported_and_other_topics_are_captured(
    capturing: StateSamples, processes: Processes, took: Callable[[str], Captured]
) -> None:
    capturing.follow({"/plan": "nav2_msgs/msg/Plan", "/amcl_pose": POSE})
    assert_golden("ros", capturing.problems["/plan"], "nav2_msgs/msg/Plan")
    processes.node("pose", "/amcl_pose", "1.0", "0", "latched")
    took("/amcl_pose")


def test_a_type_that_differs_from_the_published_one_is_reported(
    capturing: StateSamples, processes: Processes, eventually: Callable[..., None]
) -> None:
    capturing.follow({"/amcl_pose": "geometry_msgs/msg/Pose"})
    processes.node("pose", "/amcl_pose", "1.0", "0", "latched")
    eventually(lambda: capturing.drain() or capturing.problems)
    assert list(capturing.problems) == ["/amcl_pose"]
    assert_golden("ros", capturing.problems["/amcl_pose"], f"{POSE}, ", "geometry_msgs/msg/Pose: ", "state.keep")


def test_a_topic_that_this_process_uses_with_another_type_is_reported(capturing: StateSamples, graph: Graph) -> None:
    watched = graph.subscribe("/pose", "geometry_msgs/msg/Twist", depth=1)
    capturing.follow({"/pose": "geometry_msgs/msg/PoseStamped"})
    capturing.drain()
    assert_golden("ros", capturing.problems["/pose"].partition(" (")[0], "/pose", "geometry_msgs/msg/PoseStamped")
    graph.unsubscribe(watched)


def test_topics_that_are_no_longer_kept_are_unsubscribed(capturing: StateSamples, graph: Graph) -> None:
    capturing.follow({"/amcl_pose": POSE, "/odom": POSE})
    assert len(list(graph.node.subscriptions)) == 2
    capturing.follow({"/odom": POSE})
    assert [s.topic_name for s in graph.node.subscriptions] == ["/odom"]


@pytest.fixture
def lan(dds: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    """Hosts on one switch, where nodes find each other by multicast."""
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as made:
        yield made


@needs_root
def test_only_messages_of_the_active_instance_and_the_robot_are_captured(lan: Network, processes: Processes) -> None:
    pods = {"primary": "10.77.0.2", "standby": "10.77.0.3"}
    robot = "10.77.100.1"
    processes.node("pose", "/amcl_pose", "1.0", "0", "latched", inside=(primary := lan.host(pods["primary"])))
    processes.node("pose", "/odom", "10.0", "20", inside=primary)
    processes.node("pose", "/amcl_pose", "2.0", "0", "latched", inside=(standby := lan.host(pods["standby"])))
    processes.node("pose", "/odom", "20.0", "20", inside=standby)
    processes.node("pose", "/docked", "3.0", "20", inside=lan.host(robot))
    wish = {
        "topics": ["/amcl_pose", "/odom", "/docked"],
        "instances": pods,
        "active": ["primary", "standby"],
        "expect": {
            "primary": [["/amcl_pose", 1.0], ["/odom", 10.0], ["/docked", 3.0]],
            "standby": [["/amcl_pose", 2.0], ["/odom", 20.0], ["/docked", 3.0]],
        },
    }
    capturer = processes.node("capture", json.dumps(wish), inside=lan.host("10.77.200.1"))
    first, second = json.loads(processes.line(capturer, 60))
    assert {tuple(sample) for sample in first} == {
        ("/amcl_pose", 1.0, "instance"),
        ("/odom", 10.0, ""),
        ("/docked", 3.0, ""),
    }
    # The standby's pose was said once, long before it took over, and holds.
    assert {tuple(sample) for sample in second} == {
        ("/amcl_pose", 2.0, "instance"),
        ("/odom", 20.0, ""),
        ("/docked", 3.0, ""),
    }
