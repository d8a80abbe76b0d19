"""A ring keeps the last seconds of what was received, within its memory, and forgets nothing while a failure is dealt with."""

from __future__ import annotations

import tracemalloc

import pytest

from understudy.ros.observe.sample_rings import OVERHEAD, ROOM, SampleRing

TWIST = "geometry_msgs/msg/Twist"
KILO = b"x" * (1000 - OVERHEAD)


def received(ring: SampleRing, since: float = 0.0) -> dict[str, list[float]]:
    return {topic: [message[0] for message in messages] for topic, _, messages in ring.taken(since)}


def test_samples_older_than_the_window_are_dropped() -> None:
    ring = SampleRing(2.0, 1_000_000)
    track = ring.track("/cmd_vel", TWIST)
    for number in range(100):
        track.add(number * 0.1, 0.0, number, b"\0\1\0\0")
    times = received(ring)["/cmd_vel"]
    assert times[0] == pytest.approx(7.9)
    assert times[-1] == pytest.approx(9.9)
    assert ring.used == track.size == len(times) * (4 + OVERHEAD)


def test_messages_are_stored_unchanged() -> None:
    ring = SampleRing(10.0, 1_000_000)
    ring.track("/cmd_vel", TWIST).add(1.5, 1.25, 7, b"\0\1\0\0data")
    (taken,) = ring.taken(1.0)
    assert taken == ("/cmd_vel", TWIST, [(1.5, 1.25, 7, b"\0\1\0\0data")])
    assert list(ring.taken(1.6)) == []


def test_the_topic_that_needs_most_memory_is_omitted_and_reported() -> None:
    ring = SampleRing(10.0, 100_000)
    commands, images = ring.track("/cmd_vel", TWIST), ring.track("/image", "sensor_msgs/msg/Image")
    for number in range(20):
        commands.add(number * 0.1, 0.0, number, b"\0\1\0\0")
        if images.wanted:
            images.add(number * 0.1, 0.0, number, KILO * 10)
    assert len(received(ring)["/cmd_vel"]) == 20
    assert set(received(ring)) == {"/cmd_vel"}
    assert ring.left_out == {"/image": "in 10 s it takes more than all topics may together"}
    assert ring.used == commands.size <= 100_000


def test_a_message_larger_than_the_ring_removes_no_other_topic() -> None:
    ring = SampleRing(10.0, 100_000)
    ring.track("/cmd_vel", TWIST).add(0.0, 0.0, 1, KILO)
    ring.track("/map", "nav_msgs/msg/OccupancyGrid").add(0.1, 0.0, 1, bytes(200_000))
    assert set(received(ring)) == {"/cmd_vel"}
    assert set(ring.left_out) == {"/map"}


def test_samples_of_a_silent_topic_are_dropped_before_a_topic_is_omitted() -> None:
    ring = SampleRing(1.0, 100_000)
    silent, other = ring.track("/silent", TWIST), ring.track("/other", TWIST)
    for number in range(60):
        silent.add(number * 0.01, 0.0, number, KILO)
    for number in range(60):
        other.add(5.0 + number * 0.01, 0.0, number, KILO)
    assert not ring.left_out
    assert len(received(ring)["/other"]) == 60


def test_a_held_ring_forgets_nothing() -> None:
    ring = SampleRing(1.0, 1_000_000)
    track = ring.track("/cmd_vel", TWIST)
    for number in range(20):
        track.add(number * 0.1, 0.0, number, KILO)
    ring.hold(2.0)
    for number in range(20, 300):
        track.add(number * 0.1, 0.0, number, KILO)
    assert received(ring, 1.0)["/cmd_vel"][0] == pytest.approx(1.0)
    ring.release()
    track.add(30.0, 0.0, 300, KILO)
    assert received(ring)["/cmd_vel"][0] == pytest.approx(29.0)


def test_a_full_held_ring_keeps_the_samples_before_the_failure() -> None:
    ring = SampleRing(100.0, 100_000)
    track = ring.track("/cmd_vel", TWIST)
    before = int(100 * ROOM) - 1
    for number in range(before):
        track.add(number * 0.1, 0.0, number, KILO)
    ring.hold(before * 0.1)
    for number in range(before, 200):
        track.add(number * 0.1, 0.0, number, KILO)
    times = received(ring)["/cmd_vel"]
    assert times[0] == 0.0
    assert len(times) == 100, "the rest of the memory is for this"
    assert ring.full == pytest.approx(10.0)
    assert track.wanted


def test_sample_times_follow_a_clock_step() -> None:
    ring = SampleRing(1.0, 1_000_000)
    track = ring.track("/cmd_vel", TWIST)
    track.add(100.0, 0.0, 1, b"1")
    ring.shift(-50.0)
    track.add(50.1, 0.0, 2, b"2")
    assert received(ring)["/cmd_vel"] == [50.0, 50.1]
    assert not ring.left_out


def test_a_topic_with_another_type_starts_with_an_empty_ring() -> None:
    ring = SampleRing(10.0, 1_000_000)
    ring.track("/cmd_vel", TWIST).add(1.0, 0.0, 1, KILO)
    ring.track("/cmd_vel", "geometry_msgs/msg/TwistStamped").add(1.1, 0.0, 1, b"new")
    (taken,) = ring.taken(0.0)
    assert (taken.type, len(taken.messages)) == ("geometry_msgs/msg/TwistStamped", 1)
    assert ring.used == 3 + OVERHEAD
    assert not ring.left_out


def test_the_ring_uses_no_more_memory_than_it_reports() -> None:
    ring = SampleRing(1000.0, 4_000_000)
    track = ring.track("/cmd_vel", TWIST)
    tracemalloc.start()
    try:
        ring.hold(0.0)
        for number in range(20_000):
            track.add(number * 0.1, number * 0.1 + 0.05, number + 1_000_000, bytes(48) + number.to_bytes(4, "big"))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ring.full is not None
    assert taken <= 4_000_000 * 1.1
