"""What the one node sees of the graph, with and without a discovery server."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from understudy.api.kinds.robot_workload import Output
from understudy.monitor.judge.possible_senders import FORGOTTEN
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.health_tree import WatchedTopic

pytestmark = pytest.mark.ros

TOPIC = Output(topic="/chat", type="std_msgs/msg/String")
SERVICE = Output(service="/snap", type="std_srvs/srv/Trigger")
ACTION = Output(action="/goto", type="test_msgs/action/Fibonacci")


def test_a_node_is_alone_until_discovery_has_reported_another_one(graph, eventually):
    assert graph.is_alone
    other = Graph("other")
    try:
        eventually(lambda: not graph.is_alone)
    finally:
        other.close()
    eventually(lambda: graph.is_alone)


def test_endpoints_of_topics_services_and_actions_are_found(graph, processes, eventually):
    assert [graph.endpoints(output) for output in (TOPIC, SERVICE, ACTION)] == [[], [], []]
    processes.node("publish", "/chat", "10")
    processes.node("robot", "/other", "/snap", "/goto")
    eventually(lambda: graph.type_of("/chat") == "std_msgs/msg/String")
    # A server's request reader and a client's request writer.
    eventually(lambda: [len(graph.endpoints(output)) for output in (TOPIC, SERVICE, ACTION)] == [1, 2, 2])
    eventually(lambda: {endpoint.node for endpoint in graph.endpoints(SERVICE)} == {"/robot"})
    hosts = {endpoint.gid[:4] for output in (TOPIC, SERVICE, ACTION) for endpoint in graph.endpoints(output)}
    assert len(hosts) == 1


def test_the_clients_of_services_and_actions_are_found_and_told_from_their_servers(graph, processes, eventually):
    processes.node("robot", "/chat", "/snap", "/goto")
    eventually(lambda: [len(graph.clients(output)) for output in (TOPIC, SERVICE, ACTION)] == [0, 1, 2])  # goal, cancel
    eventually(lambda: [len(graph.servers_of(output)) for output in (TOPIC, SERVICE, ACTION)] == [0, 1, 2])
    caller = processes.node("call", "/snap", "/goto")
    eventually(lambda: [len(graph.clients(output)) for output in (SERVICE, ACTION)] == [2, 4])
    eventually(lambda: {end.node for end in graph.clients(SERVICE)} == {"/robot", "/caller"})
    assert [len(graph.servers_of(output)) for output in (SERVICE, ACTION)] == [1, 2]
    caller.kill()  # without a word: discovery takes up to 20 s to forget it
    eventually(lambda: [len(graph.clients(output)) for output in (SERVICE, ACTION)] == [1, 2], FORGOTTEN)


def test_publishers_with_different_types_have_no_common_type(graph, eventually):
    from std_msgs.msg import Bool, String

    other = Graph("other")
    try:
        graph.node.create_publisher(Bool, "/chat", 1)
        other.node.create_publisher(String, "/chat", 1)
        eventually(lambda: len(graph.publishers("/chat")) == 2)
        assert graph.type_of("/chat") is None
        watching = TopicWatch(graph)
        watching.follow([WatchedTopic("/chat", None, 0.0, None)])
        assert_golden("ros", watching.problems, "/chat", "std_msgs/msg/Bool", "std_msgs/msg/String")
    finally:
        other.close()


def test_the_node_offers_no_services(graph):
    assert graph.node.get_service_names_and_types_by_node("tested", "/") == []


def test_signal_handlers_are_unchanged(graph):
    import signal

    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_second_graph_can_follow_the_first(dds):
    for _ in range(2):
        graph = Graph("tested")
        graph.subscribe("/chat", "std_msgs/msg/String", depth=10)
        graph.close()


@pytest.fixture
def discovery_server(dds, monkeypatch):
    """A real Fast DDS discovery server, with its libraries found as docker/understudy-discovery-server finds them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    home = Path(sys.prefix)
    libraries = [home / "lib", *(home / "lib").glob("python3*/site-packages/*.libs")]
    server = subprocess.Popen(
        [home / "bin" / "fast-discovery-server", "-i", "0", "-l", "127.0.0.1", "-p", str(port)],
        env={**os.environ, "LD_LIBRARY_PATH": ":".join(map(str, libraries))},
        stdout=subprocess.DEVNULL,
    )
    time.sleep(0.5)
    assert server.poll() is None
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", f"127.0.0.1:{port}")
    yield
    server.kill()
    server.wait()


def test_a_discovery_server_reports_types_and_endpoints(discovery_server, processes):
    processes.node("publish", "/chat", "10")
    processes.node("robot", "/other", "/snap", "/goto")
    # In a process of its own: Fast DDS never forgets a discovery server that was in its environment once.
    looker = processes.node("look", "/chat", "/snap")
    assert json.loads(processes.line(looker, 30)) == {"type": "std_msgs/msg/String", "endpoints": 2}
