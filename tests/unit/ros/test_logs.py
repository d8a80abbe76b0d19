"""What real nodes log is judged, of the instance in control alone, and all else is not even read."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.ros.dds.host_ids import HOST, VENDOR
from understudy.ros.observe.topic_watch import TopicWatch

pytestmark = pytest.mark.ros

TREE = {"log": {"level": "ERROR", "node": "/controller", "says": "no * out", "quiet": "500ms"}}


def log(node: Any, line: str) -> None:
    node.stdin.write(f"{line}\n")
    node.stdin.flush()


def log_count(watching: TopicWatch) -> int:
    record = watching.topic("/rosout")
    return record.count if record is not None else 0


def test_only_matching_log_messages_of_the_node_fail(watching, processes, eventually, graph):
    judged = Judged(watching, TREE, grace=0.001)
    controller, planner = (processes.node("log", name) for name in ("controller", "planner"))
    eventually(lambda: judged.now() and len(graph.publishers("/rosout")) == 2)
    states = set()

    def log_lines(node: Any, *lines: str) -> None:
        """Have it log until each line has been heard: a subscription may be matched late."""
        for line in lines:
            count = log_count(watching)
            log(node, line)

            def again(line: str = line, count: int = count) -> bool:
                states.add(judged.now().state)
                if log_count(watching) == count:
                    log(node, line)
                    time.sleep(0.1)
                return log_count(watching) > count

            eventually(again)

    log_lines(planner, "error no way out")
    log_lines(controller, "warn no way out", "error a way out", "info nothing")
    assert states == {"Healthy"}
    log_lines(controller, "error no way out")
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "/controller", "/rosout", "controller says ERROR: no way out")
    eventually(lambda: judged.now().state == "Healthy")


def test_only_log_messages_of_the_instance_count(graph, processes, eventually):
    node = processes.node("log", "controller")
    eventually(lambda: graph.publishers("/rosout"))
    (host,) = {end.gid[HOST] for end in graph.publishers("/rosout")}
    watchings = [TopicWatch(graph, host), TopicWatch(graph, VENDOR + b"xx"), TopicWatch(graph)]
    judged = [Judged(watching, TREE, grace=0.001) for watching in watchings]
    watchings[2].attribute({"w-1": "192.0.2.1"}, "w-1")
    try:

        def all_heard() -> bool:
            log(node, "error no way out")
            time.sleep(0.1)
            for one in judged:
                one.now()
            return all(log_count(watching) for watching in watchings)

        eventually(all_heard)
        assert [one.now().state for one in judged] == ["Failed", "Healthy", "Healthy"]
        watchings[2].attribute({}, "")
        eventually(lambda: log(node, "error no way out") or judged[2].now().state == "Failed")
    finally:
        for watching in watchings:
            watching.close()


def test_log_messages_below_the_level_are_not_deserialized(watching, processes, eventually, monkeypatch):
    import rclpy.serialization

    judged = Judged(watching, TREE, grace=0.001)
    node = processes.node("log", "controller")
    read = []
    real = rclpy.serialization.deserialize_message
    monkeypatch.setattr(
        rclpy.serialization, "deserialize_message", lambda *arguments: read.append(1) or real(*arguments)
    )

    def some() -> bool:
        log(node, "warn no way out")
        time.sleep(0.05)
        return judged.now().state == "Healthy" and log_count(watching) > 3

    eventually(some)
    assert not read
    eventually(lambda: log(node, "error no way out") or judged.now().state == "Failed")
    assert read
