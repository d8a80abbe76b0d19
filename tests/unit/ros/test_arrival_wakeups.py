"""A descriptor reports messages that may show a failure when they arrive; all others wait for the next read."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("rclpy")

from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.trees.core.health_tree import WatchedTopic

pytestmark = pytest.mark.ros

STRING = "std_msgs/msg/String"
CHAT = WatchedTopic("/chat", STRING, 0.0, 50.0)


@pytest.fixture
def arrivals(graph: Any) -> Iterator[ArrivalWakeups]:
    made = ArrivalWakeups()
    yield made
    made.close()


@pytest.fixture
def watching(graph: Any, arrivals: ArrivalWakeups) -> Iterator[TopicWatch]:
    made = TopicWatch(graph, arrivals=arrivals)
    yield made
    made.close()


def is_signalled(arrivals: ArrivalWakeups, within: float) -> bool:
    return bool(select.select([arrivals.descriptor], [], [], within)[0])


def received(watching: TopicWatch, eventually: Callable[..., None], topic: str = "/chat", more: int = 5) -> None:
    before = watching.topic(topic).count
    eventually(lambda: watching.drain() and watching.topic(topic).count >= before + more)


def test_an_arrival_is_signalled_at_once_and_no_message_is_lost(watching, arrivals, processes, eventually):
    watching.follow([replace(CHAT, prompt=True)])
    processes.node("publish", "/chat", "20")
    for _ in range(5):
        assert is_signalled(arrivals, 20)
        arrivals.clear()
        assert watching.drain() or is_signalled(arrivals, 20)  # what was cleared may have been looked at before
    received(watching, eventually, more=20)
    (source,) = watching.records("/chat").values()
    assert source.lost == 0


def test_messages_of_other_topics_are_not_signalled(watching, arrivals, processes, eventually):
    watching.follow([replace(CHAT, prompt=True), replace(CHAT, name="/talk")])
    processes.node("publish", "/talk", "50")
    received(watching, eventually, "/talk")
    assert not is_signalled(arrivals, 0.0)


def test_wakeups_follow_the_tree(watching, arrivals, processes, eventually):
    watching.follow([CHAT])
    processes.node("publish", "/chat", "50")
    received(watching, eventually)
    assert not arrivals.asked
    assert not is_signalled(arrivals, 0.0)
    watching.follow([replace(CHAT, prompt=True)])
    assert is_signalled(arrivals, 20)
    watching.follow([CHAT])
    time.sleep(0.1)  # a call that is under way ends
    arrivals.clear()
    received(watching, eventually)
    assert not is_signalled(arrivals, 0.0)


def test_a_message_that_already_waits_is_signalled(watching, arrivals, processes, eventually):
    watching.follow([CHAT])
    publisher = processes.node("publish", "/chat", "50")
    received(watching, eventually)
    time.sleep(0.2)
    publisher.kill()
    publisher.wait()
    watching.follow([replace(CHAT, prompt=True)])
    assert is_signalled(arrivals, 20)


def test_a_removed_topic_is_no_longer_signalled(watching, arrivals, processes, eventually):
    watching.follow([replace(CHAT, prompt=True)])
    processes.node("publish", "/chat", "50")
    received(watching, eventually)
    watching.follow([replace(CHAT, name="/talk", prompt=True)])
    arrivals.clear()
    assert not is_signalled(arrivals, 0.2)
