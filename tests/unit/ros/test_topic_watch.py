"""Topics are watched without being spun: what was received when, from how often one looks."""

import signal
import time

import pytest

from tests.support.clock import set_clock
from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message

from understudy.ros.observe import topic_watch as module
from understudy.ros.observe.sample_rings import SampleRing
from understudy.ros.observe.topic_watch import TopicWatch, depth
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.interface_types import message_class
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.languages.short.health_loader import load

pytestmark = pytest.mark.ros

STRING = "std_msgs/msg/String"


def watch(watching, seconds, tick=0.05):
    end = time.time() + seconds
    while time.time() < end:
        watching.drain()
        time.sleep(tick)


@pytest.mark.parametrize(("rate", "expected"), [(None, 13), (1.0, 10), (50.0, 13), (400.0, 100), (10_000.0, 1000)])
def test_the_queue_is_long_enough_for_a_stall(rate, expected):
    assert depth(WatchedTopic("/t", STRING, 0.0, rate)) == expected


def test_arrival_times_are_those_of_receipt_not_of_reading(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 5.0, 400.0)])  # a queue for two seconds, on a busy machine
    processes.node("publish", "/chat", "50")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 5)
    before = watching.topic("/chat").count
    watch(watching, 2.0, tick=0.2)
    record = watching.topic("/chat")
    assert record.count - before == pytest.approx(100, abs=30)
    gaps = [later - earlier for earlier, later in zip(record.arrivals, list(record.arrivals)[1:], strict=False)]
    assert sorted(gaps)[len(gaps) // 2] == pytest.approx(0.02, abs=0.01)
    (source,) = watching.records("/chat").values()
    assert (source.count, source.lost) == (record.count, 0)


def test_lost_samples_are_counted(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 0.0, None)])
    processes.node("publish", "/chat", "100")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 5)
    time.sleep(1.0)  # 13 of 100 fit
    watching.drain()
    (source,) = watching.records("/chat").values()
    assert source.lost > 30


def test_samples_that_a_stall_lost_begin_a_new_time_of_observation(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 0.0, None)])
    processes.node("publish", "/chat", "100")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 5)
    time.sleep(0.6)  # 13 of 60 fit
    before = time.time()
    watching.drain()
    record = watching.topic("/chat")
    assert before - 0.3 <= record.observed_since <= time.time() + module.CATCH_UP
    time.sleep(module.LONG_STALL + 0.1)
    before = time.time()
    watching.drain()
    assert watching.topic("/chat").observed_since >= before, "samples of a long stall may be stamped late"


def test_messages_are_recorded_unchanged_while_there_is_a_ring(watching, processes, eventually):
    ring = SampleRing(60.0, 1_000_000)
    watching.follow([WatchedTopic("/chat", None, 0.0, None)])  # its type is only known once somebody publishes it
    watching.record(ring)
    processes.node("publish", "/chat", "50", "100")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 5)
    watching.follow([WatchedTopic("/chat", None, 0.0, 400.0)])  # by another subscription
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 15)
    (taken,) = ring.taken(0.0)
    assert (taken.topic, taken.type, len(taken.messages)) == ("/chat", STRING, watching.topic("/chat").count)
    assert {deserialize_message(data, message_class(STRING)).data for *_, data in taken.messages} == {"x" * 100}
    assert [received for received, *_ in taken.messages][-1] == watching.topic("/chat").last
    assert all(sent <= received for received, sent, *_ in taken.messages)
    watching.record(None)
    before = watching.topic("/chat").count
    eventually(lambda: watching.drain() and watching.topic("/chat").count > before + 5)
    assert len(next(ring.taken(0.0)).messages) == len(taken.messages)


def test_the_type_comes_from_the_graph_if_the_tree_gives_none(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", None, 0.0, None)])
    assert_golden("ros", watching.waiting, "/chat")
    processes.node("publish", "/chat", "20")
    eventually(lambda: watching.drain() and watching.topic("/chat").count)
    assert watching.waiting == watching.problems == []


def test_a_topic_with_a_missing_type_is_reported_and_the_others_are_watched(watching, processes, eventually):
    watching.follow([WatchedTopic("/plan", "nav2_msgs/msg/Plan", 0.0, None), WatchedTopic("/chat", STRING, 0.0, None)])
    (problem,) = watching.problems
    assert_golden("ros", problem, "/plan", "nav2_msgs/msg/Plan")
    assert problem.endswith("set spec.monitor.image to that")
    assert watching.unwatchable == {"/plan"}
    processes.node("publish", "/chat", "20")
    eventually(lambda: watching.drain() and watching.topic("/chat").count)
    assert watching.topic("/plan").last is None


@pytest.mark.parametrize("name", ["HelloWorld", "example_interfaces/srv/AddTwoInts", "a/msg/b/C"])
def test_a_topic_with_an_invalid_type_is_reported_and_the_others_are_watched(watching, graph, monkeypatch, name):
    # Whoever publishes by DDS alone calls its types as it likes.
    monkeypatch.setattr(graph, "type_of", lambda topic: name)
    watching.follow([WatchedTopic("/native", None, 0.0, None), WatchedTopic("/scan", STRING, 0.0, None)])
    watching.drain()
    (problem,) = watching.problems
    assert problem.startswith(f"/native cannot be received: '{name}' is not a ")
    assert watching.unwatchable == {"/native"}


def test_a_topic_that_this_process_uses_with_another_type_is_reported(watching, graph):
    kept = graph.subscribe("/pose", STRING, depth=1)
    other = WatchedTopic("/pose", "geometry_msgs/msg/PoseStamped", 0.0, None)
    watching.follow([other, WatchedTopic("/scan", STRING, 0.0, None)])
    watching.drain()
    (problem,) = watching.problems
    assert_golden("ros", problem.partition(" (")[0], "/pose", "geometry_msgs/msg/PoseStamped")
    graph.unsubscribe(kept)


def test_a_change_of_topics_keeps_the_records_of_the_remaining_ones(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 0.0, None), WatchedTopic("/talk", STRING, 0.0, None)])
    processes.node("publish", "/chat", "20")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 3)
    before = watching.topic("/chat").count
    watching.follow([WatchedTopic("/chat", STRING, 2.0, None)])
    assert watching.topic("/talk") is None
    assert watching.topic("/chat").count == before
    assert watching.topic("/chat").window >= 2.0
    assert len(watching.topic("/chat").arrivals) > 1
    watch(watching, 0.5)
    assert watching.topic("/chat").count > before


def test_hosts_that_are_silent_for_long_are_forgotten(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 0.0, None)])
    gone = module.SourceRecord(10.0)
    gone.add(time.time() - 2 * module.FORGET)
    watching.records("/chat")[b"gone"] = gone
    processes.node("publish", "/chat", "20")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 3)
    assert b"gone" not in watching.records("/chat")


def test_a_faster_expected_rate_gets_a_longer_queue(watching, graph):
    watching.follow([WatchedTopic("/chat", STRING, 0.0, None)])
    watching.follow([WatchedTopic("/chat", STRING, 2.0, 400.0)])
    (subscription,) = graph.node.subscriptions
    assert subscription.qos_profile.depth == 100


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_clock_step_is_neither_a_gap_nor_a_burst(watching, processes, eventually, monkeypatch, step):
    watching.follow([WatchedTopic("/chat", STRING, 1.0, None)])
    processes.node("publish", "/chat", "50")
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 60)

    time.sleep(0.1)
    set_clock(monkeypatch, step)  # samples in the queue are still stamped by the old clock
    watching.drain()
    record, now = watching.topic("/chat"), time.time()
    assert 0 <= now - record.last < 1
    assert list(record.arrivals) == sorted(record.arrivals)
    assert 0 <= now - record.arrivals[0] < 10
    assert sum(now - 1 < arrival <= now for arrival in record.arrivals) == pytest.approx(50, abs=30)


def test_a_frozen_publisher_is_detected_at_the_deadline(watching, processes, eventually):
    tree = load({"topic": {"name": "/chat", "type": STRING, "gap": "200ms"}})
    watching.follow(tree.topics)
    publisher = processes.node("publish", "/chat", "50")
    since = time.time()
    eventually(lambda: watching.drain() and watching.topic("/chat").count > 10)
    publisher.send_signal(signal.SIGSTOP)
    while True:
        watching.drain()
        now = time.time()
        verdict = tree.evaluate(watching, now=now, since=since)
        if verdict.state == "Failed":
            break
        due = tree.deadline(watching, now=now, since=since)
        time.sleep(max(0.0, min(due - now + 0.0005, 0.05)))
    assert verdict.reason == "no /chat for 200 ms"
    assert verdict.onset == watching.topic("/chat").last
    assert 0 <= now - (verdict.onset + 0.2) < 0.5  # the bench measures it; here a busy machine must not matter


def test_a_restarted_publisher_has_a_newer_writer_and_a_frozen_one_has_not(watching, processes, eventually):
    watching.follow([WatchedTopic("/chat", STRING, 5.0, None)])

    def heard(number):
        before = watching.topic("/chat").count
        eventually(lambda: watching.drain() and watching.topic("/chat").count > before + number)

    publisher = processes.node("publish", "/chat", "50")
    heard(5)
    (source,) = watching.records("/chat").values()
    first = source.newest_writer
    publisher.send_signal(signal.SIGSTOP)
    watch(watching, 0.5)
    publisher.send_signal(signal.SIGCONT)
    heard(5)
    assert source.newest_writer == first
    publisher.kill()
    publisher.wait()
    processes.node("publish", "/chat", "50")
    heard(20)
    assert source.newest_writer > first


STATUS = "/count/_action/status"


def test_the_status_of_an_action_shows_an_active_goal(graph, processes, eventually):
    worker = processes.node("work", "/count")
    first = TopicWatch(graph)
    first.follow([WatchedTopic(STATUS, "action_msgs/msg/GoalStatusArray", 0.0, None, task=True)])
    eventually(lambda: first.drain() and first.task(STATUS))
    assert first.task(STATUS) == pytest.approx(time.time(), abs=20)
    late = TopicWatch(graph)
    late.follow([WatchedTopic(STATUS, "action_msgs/msg/GoalStatusArray", 0.0, None, task=True)])
    eventually(lambda: late.drain() and late.task(STATUS))
    worker.stdin.write("succeed\n")
    worker.stdin.flush()
    for watching in (first, late):
        eventually(lambda watching=watching: watching.drain() is not None and watching.task(STATUS) is None)
        watching.close()


def test_a_goal_is_not_active_without_its_server(watching, processes, eventually):
    worker = processes.node("work", "/count")
    watching.follow([WatchedTopic(STATUS, "action_msgs/msg/GoalStatusArray", 0.0, None, task=True)])
    eventually(lambda: watching.drain() and watching.task(STATUS))
    worker.stdin.write("end\n")
    worker.stdin.flush()
    # If a process crashes as it ends, which rclpy's sometimes does, DDS notices only after the lease duration of 20 s.
    eventually(lambda: watching.drain() is not None and watching.task(STATUS) is None, timeout=45)


def test_goals_of_an_inactive_instance_do_not_count(watching, processes, eventually, address_of):
    processes.node("work", "/count")
    watching.follow([WatchedTopic(STATUS, "action_msgs/msg/GoalStatusArray", 0.0, None, task=True)])
    eventually(lambda: watching.drain() and watching.active(STATUS))
    (gid,) = watching.active(STATUS)
    pods = {"elsewhere": "192.0.2.1"}
    watching.attribute(pods, "elsewhere")
    assert watching.task(STATUS) is not None, "a server in no pod of the workload's, such as a proxy"
    watching.attribute({**pods, "standby": address_of(MIDDLEWARE.host_of(gid))}, "elsewhere")
    assert watching.task(STATUS) is None
