"""What the black box keeps of a real failure, in the hands of other tools: rosbags, a reader of rosbag2's files that shares nothing with
the library they are written with; ROS's own types; and a player that does as `ros2 bag play`.

rosbag2 itself isn't on PyPI. What its reader insists on beyond that is looked at one by one.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
import yaml
from geometry_msgs.msg import Twist
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.unit.dds import isolate_discovery
from tests.unit.monitor.recorded_monitor import Monitored
from understudy.monitor.report import black_box as module
from understudy.ros.runtime.interface_types import message_class

pytestmark = pytest.mark.ros

TYPES = {
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/understudy/tree": "std_msgs/msg/String",
    "/understudy/events": "rcl_interfaces/msg/Log",
}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
async def recorded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A recording of a failure of a node whose last command is latched."""
    isolate_discovery(monkeypatch)
    monkeypatch.setattr(module, "AFTER", 0.3)
    monitored = Monitored(tmp_path / "recordings")
    node = monitored.observer.graph.node
    node.destroy_publisher(monitored.publisher)
    monitored.publisher = node.create_publisher(Twist, "/cmd_vel", LATCHED)
    running = asyncio.create_task(monitored.box.run())
    await monitored.driven()
    progress = monitored.fail()
    await monitored.look(0.1)
    monitored.recovered(progress)
    await monitored.driven(5)
    await monitored.recorded()
    running.cancel()
    monitored.observer.graph.close()
    return monitored.archive.path(monitored.archive.recordings[0])


@pytest.fixture
def bag(recorded: Path) -> Iterator[Reader]:
    with Reader(recorded) as reader:
        yield reader


def ext(connection: Connection) -> ConnectionExtRosbag2:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    return connection.ext


def test_topics_have_their_types_and_counts(bag: Reader) -> None:
    assert {one.topic: one.msgtype for one in bag.connections} == TYPES
    assert {ext(one).serialization_format for one in bag.connections} == {"cdr"}
    counts = {one.topic: one.msgcount for one in bag.connections}
    assert counts["/cmd_vel"] > 20
    assert all(counts.values())
    assert sum(counts.values()) == bag.message_count == len(list(bag.messages()))
    assert 0 < bag.duration < 20e9
    assert abs(bag.end_time - time.time_ns()) < 60e9


def test_times_are_ascending(bag: Reader) -> None:
    times = [at for _, at, _ in bag.messages()]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (bag.start_time, bag.end_time - 1)


def test_topics_have_the_offered_qos(bag: Reader) -> None:
    offered = {one.topic: ext(one).offered_qos_profiles for one in bag.connections}
    (profile,) = offered.pop("/cmd_vel")
    assert (profile.reliability.name, profile.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")
    assert not any(offered.values()), "what Understudy adds is offered as usual"


def test_the_recorded_definitions_are_sufficient_to_read_every_message(bag: Reader) -> None:
    store = get_typestore(Stores.EMPTY)
    for one in bag.connections:
        assert one.msgdef.format == MessageDefinitionFormat.MSG
        store.register({**get_types_from_msg(one.msgdef.data, one.msgtype)})
    for one, _, data in bag.messages():
        read = store.deserialize_cdr(data, one.msgtype)
        assert contents(read) == contents(deserialize_message(data, message_class(one.msgtype))), (
            "as ROS's own types read it"
        )


def contents(message: Any) -> Any:
    """A message without its class, whoever read it."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: contents(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if dataclasses.is_dataclass(message):
        names = [field.name for field in dataclasses.fields(message)]
        return {name: contents(getattr(message, name)) for name in names if name[0].islower()}  # and no constants
    return message


def test_the_file_has_what_rosbag2_requires(recorded: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None, "it dereferences these"
    assert set(summary.statistics.channel_message_counts) == set(summary.channels)
    assert len({one.topic for one in summary.channels.values()}) == len(summary.channels), "a topic is listed once"
    assert {one.message_encoding for one in summary.channels.values()} == {"cdr"}, "or it refuses to open it"
    for channel in summary.channels.values():
        assert summary.schemas[channel.schema_id].data, "a channel without a schema is refused"
        assert isinstance(yaml.safe_load(channel.metadata["offered_qos_profiles"]), list)
    assert summary.chunk_indexes
    assert all(_ordered(one) for one in summary.chunk_indexes), "or it can't be read in the order of time"


def _ordered(chunk: ChunkIndex) -> bool:
    return chunk.message_index_length > 0 and chunk.compression in ("", "zstd", "lz4")


async def test_recorded_topics_are_played_with_the_offered_qos(bag: Reader) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("plays", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    publishers = {one.topic: _publisher(node, one) for one in bag.connections}
    played: dict[str, bytes] = {}
    for one, _, data in bag.messages():
        publishers[one.topic].publish(data)
        played[one.topic] = data
    late: list[Twist] = []
    subscription = node.create_subscription(Twist, "/cmd_vel", late.append, LATCHED)
    end = time.monotonic() + 20
    while not late and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    assert [bytes(serialize_message(one)) for one in late] == [played["/cmd_vel"]]
    node.destroy_subscription(subscription)
    node.destroy_node()
    context.shutdown()


def _publisher(node: Any, connection: Connection) -> Any:
    """As `ros2 bag play` makes them: by the profile that was offered, of a usual history, or as usual."""
    offered = ext(connection).offered_qos_profiles
    qos = QoSProfile(depth=10)
    if offered:
        qos.reliability = ReliabilityPolicy[offered[0].reliability.name]
        qos.durability = DurabilityPolicy[offered[0].durability.name]
    return node.create_publisher(message_class(connection.msgtype), connection.topic, qos)
