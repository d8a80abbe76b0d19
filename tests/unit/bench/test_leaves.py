"""Benches judge what they measure by the same limits as the tree does."""

import random
from collections import Counter

import pytest

from bench import detection, manipulator
from bench.detection import FAILURES, Failure, due, plan
from bench.leaves import LEAVES, STREAMS, own_fault, topics, tree
from understudy.trees.languages.short.health_loader import load

BY_PATH = {leaf.path: leaf for leaf in LEAVES}


@pytest.fixture(scope="module")
def loaded():
    return load(tree())


def test_the_tree_has_twenty_leaves_with_these_paths_and_topics(loaded):
    assert len(loaded.leaves) == 20
    assert [leaf.name for leaf in loaded.leaves] == list(BY_PATH)
    for leaf in loaded.leaves:
        if topic := BY_PATH[leaf.name].topic:
            assert leaf.topic == topic
    status = "/navigate_to_pose/_action/status"
    assert {topic.name for topic in loaded.topics if topic.subscribed} == {*topics(), status}


def test_the_topic_of_a_leaf_is_published_with_its_type_by_its_process(loaded):
    types = {topic.name: topic.type for topic in loaded.topics}
    for leaf in LEAVES:
        if leaf.topic and leaf.kind not in ("log", "lifecycle"):
            (stream,) = (stream for stream in STREAMS[leaf.process] if stream.key == leaf.key)
            assert types[leaf.topic] == stream.type


def test_every_failure_has_a_leaf_and_all_are_equally_frequent():
    assert {failure.leaf for failure in FAILURES} <= BY_PATH.keys()
    for count in (1, 18, 100):
        planned = Counter(failure.leaf + failure.kind for failure in plan(count, random.Random(1)))
        assert planned.total() == count
        assert max(planned.values()) - min(planned.values(), default=0) <= 1


@pytest.mark.parametrize(
    ("path", "failure", "started_at", "arrivals", "moment"),
    [
        ("driving/cmd_vel", {}, 10.02, [9.9, 9.95, 10.0], 10.3),
        ("transforms/base_link", {}, 10.02, [10.0, 10.01], 10.29),
        ("sensors/lidar", {}, 10.0, [9.0 + n / 15 for n in range(16)], 9.0 + 5 / 15 + 1.0),
        ("sensors/imu", {"hertz": 50}, 10.0, [9.0 + n / 100 for n in range(100)], 9.0 + 19 / 100 + 1.0),
        ("state/battery", {"spoil": "empty"}, 10.0, [9.8, 10.001, 10.2], 10.001),
        ("state/motors", {"spoil": "motors: left"}, 10.0, [9.8, 10.001, 10.2], 10.301),
        ("state/battery", {"spoil": "empty"}, 10.3, [9.8, 10.001, 10.2], None),
    ],
)
def test_a_failure_counts_from_the_moment_that_its_limit_gives(path, failure, started_at, arrivals, moment):
    found = due(BY_PATH[path], Failure("some", path, failure), started_at, {"arrivals": arrivals, "onset": 9.99})
    assert found == (pytest.approx(moment) if moment is not None else None)


def test_a_node_that_was_removed_is_missing_from_that_moment():
    failure = Failure(detection.GRAPH, "state/speaker", do="remove_node")
    assert due(BY_PATH["state/speaker"], failure, 10.0, {"arrivals": []}) == 10.0


def sends(*times, lag=0.001):
    return [(time - lag, time) for time in times]


@pytest.mark.parametrize(
    ("path", "sent", "fault"),
    [
        ("driving/cmd_vel", sends(9.6, 9.65, 10.0), "nothing was sent for 350 ms"),
        ("driving/cmd_vel", sends(9.6, 9.65, 9.7), "nothing was sent for 310 ms"),
        ("driving/cmd_vel", sends(9.6, 9.8, 10.0), ""),
        ("driving/cmd_vel", sends(5.0, 7.0, *(7.5 + n / 10 for n in range(25))), ""),
        ("driving/cmd_vel", [], "nothing was sent"),
        ("sensors/lidar", sends(*(7.0 + n / 14.5 for n in range(44))), ""),
        ("sensors/lidar", sends(*(7.0 + n / 14.5 for n in range(44) if not 36 <= n < 41)), "9 were sent within 1 s"),
        ("sensors/odom", sends(*(7.0 + n / 91.5 for n in range(273))), "92 were sent within 1 s"),
        ("sensors/lidar_age", sends(9.9, lag=0.3), "one was sent 300 ms after it had been stamped"),
        ("sensors/lidar_age", sends(9.9, lag=0.2), ""),
    ],
)
def test_an_alarm_is_true_if_the_sender_was_late_by_its_own_clock(path, sent, fault):
    assert own_fault(BY_PATH[path], sent, 10.01) == fault


def test_the_tree_of_the_manipulator_uses_all_published_topics():
    judged = load(manipulator.monitoring()["yaml"])
    topics = {topic.name: topic for topic in judged.topics if not topic.task}
    assert {name: topic.type for name, topic in topics.items()} == {one.topic: one.type for one in manipulator.STREAMS}
    assert {topic.name for topic in judged.topics if topic.task} == {f"{a}/_action/status" for a in manipulator.ACTIONS}
    assert len(manipulator.STREAMS) == 10
