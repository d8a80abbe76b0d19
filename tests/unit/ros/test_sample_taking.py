"""Samples come out of the queue with their data, times, sequence numbers and who sent them."""

import time

import pytest

pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from understudy.ros.runtime.sample_taking import SampleTaker

pytestmark = pytest.mark.ros


@pytest.fixture
def subscription(graph):
    return graph.subscribe("/chat", "std_msgs/msg/String", depth=10)


def taken(subscription, *, count: int, timeout: float = 10.0, **how):
    taker, samples, end = SampleTaker(), [], time.monotonic() + timeout
    with subscription.handle:
        while len(samples) < count and time.monotonic() < end:
            sample = taker.take(subscription.handle.pointer, **how)
            if sample is not None:
                samples.append(sample)
            else:
                time.sleep(0.005)
    assert len(samples) == count
    return samples


def publisher(graph, eventually):
    made = graph.node.create_publisher(String, "/chat", 10)
    eventually(lambda: made.get_subscription_count() == 1)
    return made


def test_samples_have_data_times_and_a_sequence_number(graph, subscription, eventually):
    publish = publisher(graph, eventually).publish
    before = time.time()
    for text in ("a", "bc"):
        publish(String(data=text))
    first, second = taken(subscription, count=2)
    assert [deserialize_message(s.data, String).data for s in (first, second)] == ["a", "bc"]
    assert before <= first.sent <= first.received <= second.received <= time.time()
    assert second.sequence == first.sequence + 1


def test_the_gid_of_a_sample_is_that_of_its_publisher(graph, subscription, eventually):
    publisher(graph, eventually).publish(String(data="a"))
    (sample,) = taken(subscription, count=1)
    eventually(lambda: graph.publishers("/chat"))
    (endpoint,) = graph.publishers("/chat")
    assert sample.gid == endpoint.gid


def test_two_publishers_have_two_gids(graph, subscription, eventually):
    publishers = [publisher(graph, eventually), publisher(graph, eventually)]
    for each in publishers:
        each.publish(String(data="a"))
    assert len({sample.gid for sample in taken(subscription, count=2)}) == 2


def test_the_buffer_grows_and_is_reused(graph, subscription, eventually):
    publish = publisher(graph, eventually).publish
    texts = ["short", "x" * 300_000, "y"]
    for text in texts:
        publish(String(data=text))
        (sample,) = taken(subscription, count=1)
        assert deserialize_message(sample.data, String).data == text


def test_data_is_omitted_if_it_is_not_requested(graph, subscription, eventually):
    publisher(graph, eventually).publish(String(data="a"))
    (sample,) = taken(subscription, count=1, with_data=False)
    assert sample.data == b""


def test_an_empty_queue_gives_no_sample(subscription):
    with subscription.handle:
        assert SampleTaker().take(subscription.handle.pointer) is None


def test_the_queue_keeps_the_newest_samples(graph, subscription, eventually):
    publish = publisher(graph, eventually).publish
    for number in range(30):
        publish(String(data=str(number)))
        time.sleep(0.002)
    time.sleep(0.2)
    samples = taken(subscription, count=10)
    assert [deserialize_message(s.data, String).data for s in samples] == [str(n) for n in range(20, 30)]
