"""A real action server's feedback tells whether its goal gets on."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.ros.runtime.interface_types import TypeNotInstalled, message_class, message_fields

pytestmark = pytest.mark.ros

TYPE = "test_msgs/action/Fibonacci"
FEEDBACK = "/go/_action/feedback"


def feed_back(server: Any, *numbers: int) -> None:
    server.stdin.write(f"{list(numbers)}\n")
    server.stdin.flush()


def fed(watching: Any) -> int:
    record = watching.topic(FEEDBACK)
    return record.count if record is not None else 0


def test_a_goal_without_progress_fails_despite_feedback_and_recovers_at_its_end(watching, processes, eventually):
    leaf = {"action": "/go", "type": TYPE, "grows": "sequence[-1]", "by": 2, "within": "2s", "settle": "10ms"}
    judged = Judged(watching, {"progress": {**leaf, "gap": "30s"}}, grace=0.001)
    assert judged.now().state == "Healthy"
    server = processes.node("work", "/go")
    number = 1

    def say() -> bool:
        feed_back(server, 0, number)
        judged.now()
        return fed(watching) > 0

    eventually(say)
    for _ in range(20):
        number += 2
        count = fed(watching)
        feed_back(server, 0, number)
        eventually(lambda count=count: judged.now() and fed(watching) > count)
    assert judged.now().state == "Healthy"
    due = None
    while (verdict := judged.now()).state == "Healthy":
        due = judged.deadline() or due
        feed_back(server, 0, number + 1)
        time.sleep(0.02)
    assert due is not None
    assert due <= time.time(), "it fails at the deadline, not before"
    assert verdict.reason == (
        f"sequence[-1] of /go did not increase by 2 within 2 s (compared with {number}) while a goal of /go is active"
    )
    feed_back(server, 0, number + 2)
    eventually(lambda: judged.now().state == "Healthy")
    server.stdin.write("succeed\n")
    server.stdin.flush()
    eventually(lambda: judged.now() and watching.task("/go/_action/status") is None)
    assert judged.now().state == "Healthy", "there is nothing to get on with"
    assert judged.deadline() is None


def test_silence_fails_after_the_gap_without_a_given_type(watching, processes, eventually):
    judged = Judged(watching, {"progress": {"action": "/go", "gap": "1s", "settle": "10ms"}}, grace=0.001)
    server = processes.node("work", "/go")
    eventually(lambda: feed_back(server, 1) or (judged.now().state == "Healthy" and fed(watching)))
    assert_golden("ros", judged.until_failed().reason, "/go", "1 s")
    eventually(lambda: feed_back(server, 1) or judged.now().state == "Healthy")


def test_the_types_of_feedback_are_found():
    assert list(message_fields(f"{TYPE}_FeedbackMessage")) == ["goal_id", "feedback"]
    assert list(message_fields(f"{TYPE}_Feedback")) == ["sequence"]
    assert message_fields("no_such_msgs/action/Go_Feedback") is None
    with pytest.raises(TypeNotInstalled, match="no_such_msgs/action/Go is not installed in the monitor's image"):
        message_class("no_such_msgs/action/Go_FeedbackMessage")
    with pytest.raises(ValueError, match="is not a message type"):
        message_class(TYPE)
