"""What is written of a failure is what other tools read: every message byte by byte, with its type, in the order of time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rclpy")

from mcap.reader import make_reader
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from understudy.api.kinds.robot_workload import Attempt, Moments, Recovery
from understudy.cli.simulate.bags import Bag
from understudy.monitor.report import mcap_writer
from understudy.monitor.report.mcap_writer import Content, Trace
from understudy.ros.observe.offered_qos import offers
from understudy.ros.observe.sample_rings import SampleRing
from understudy.ros.runtime.interface_types import message_class

pytestmark = pytest.mark.ros

FAILED = 1_780_000_030.25
REASON = "no /cmd_vel for 500 ms"
TREE: dict[str, Any] = {
    "name": "parallel", "kind": "parallel", "state": "Failed", "reason": "",
    "children": [{"name": "cmd_vel", "kind": "topic", "state": "Failed", "reason": REASON, "topic": "/cmd_vel", "received": 3, "age": 0.5}],
}  # fmt: skip


def event(reason: str, at: str, kind: str = "Normal") -> dict[str, Any]:
    about = {"kind": "RobotWorkload", "name": "robot-1-drive"}
    return {
        "metadata": {"name": reason},
        "involvedObject": about,
        "type": kind,
        "reason": reason,
        "message": "so",
        "lastTimestamp": at,
    }


def recovery() -> Recovery:
    moments = Moments(detected="2026-05-28T20:27:10.250000Z", routed="2026-05-28T20:27:10.260000Z")
    attempts = [Attempt(strategy="Fallback/Executing", pod="b", result="Verified")]
    return Recovery(
        id="abc", number=3, reason=REASON, result="Recovered", strategy="Fallback/Executing", from_pod="a", to_pod="b", moments=moments,
        attempts=attempts,
    )  # fmt: skip


def twist(speed: float) -> bytes:
    message = message_class("geometry_msgs/msg/Twist")()
    message.linear.x = speed
    return mcap_writer.serialized(message)


@pytest.fixture
def ring() -> SampleRing:
    made = SampleRing(30.0, 1_000_000)
    for number in range(50):
        at = FAILED - 5 + number * 0.1
        made.track("/cmd_vel", "geometry_msgs/msg/Twist").add(at, at - 0.01, number + 1, twist(number / 10))
        made.track("/scan", "sensor_msgs/msg/LaserScan").add(
            at + 0.05,
            0.0,
            number,
            mcap_writer.serialized(message_class("sensor_msgs/msg/LaserScan")(ranges=[1.0, float(number)])),
        )
    record = {"time": FAILED, "health": "Failed", "active": "a", "epoch": 4, "tree": TREE}
    made.track(mcap_writer.TREE, mcap_writer.TREE_TYPE).add(FAILED, FAILED, 0, mcap_writer.text(json.dumps(record)))
    return made


@pytest.fixture
def file(ring: SampleRing, tmp_path: Path) -> Path:
    events = [
        event("FailureDetected", "2026-05-28T20:27:10Z", "Warning"), event("Old", "2026-05-28T19:00:00Z"),
        event("Recovered", "2026-05-28T20:27:11Z"),
    ]  # fmt: skip
    notes = {"leftOut": '{"/image": "too much"}'}
    offered = {"/cmd_vel": offers([QoSProfile(depth=7)]), "/scan": offers([])}
    content = Content("fleet", "robot-1-drive", recovery(), list(ring.taken(0.0)), events, offered, FAILED - 30, notes)
    path = tmp_path / "recording.mcap"
    with path.open("wb") as out:
        assert mcap_writer.write(out, content) == 101 + 2 + 2
    return path


def test_every_message_is_recorded_unchanged(file: Path, ring: SampleRing) -> None:
    with file.open("rb") as opened:
        reader = make_reader(opened, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        read = [(s.name, s.encoding, c.topic, c.message_encoding, m) for s, c, m in reader.iter_messages() if s]
    assert {encoding for *_, encoding, _ in read} == {"cdr"}, "rosbag2 plays no file with other ones among them"
    assert {encoding for _, encoding, *_ in read} == {"ros2msg"}
    for topic, type_, messages in ring.taken(0.0):
        found = [(m.log_time, m.publish_time, m.data) for name, _, at, _, m in read if (at, name) == (topic, type_)]
        ns = [round(received * 1e9) for received, *_ in messages]
        sent = [round((sent or received) * 1e9) for received, sent, *_ in messages]
        assert found == list(zip(ns, sent, [data for *_, data in messages], strict=True))
    times = [m.log_time for *_, m in read]
    assert times == sorted(times)


def test_the_file_opens_as_a_rosbag2_bag(file: Path) -> None:
    with Bag.open(str(file)) as bag:
        assert {topic.name: topic.types for topic in bag.topics.values()} == {
            "/cmd_vel": ("geometry_msgs/msg/Twist",),
            "/scan": ("sensor_msgs/msg/LaserScan",),
            "/understudy/tree": ("std_msgs/msg/String",),
            "/understudy/events": ("rcl_interfaces/msg/Log",),
        }
        commands = list(bag.messages({"/cmd_vel": "geometry_msgs/msg/Twist"}))
        read: Any = bag.definitions.read(commands[7].data, "geometry_msgs/msg/Twist")
        assert (len(commands), read.linear.x) == (50, 0.7)


def test_each_topic_has_the_qos_that_its_publishers_offered(file: Path) -> None:
    with file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    assert summary is not None
    profiles = {one.topic: yaml.safe_load(one.metadata["offered_qos_profiles"]) for one in summary.channels.values()}
    assert [one["depth"] for one in profiles.pop("/cmd_vel")] == [7]
    assert profiles == {"/scan": [], mcap_writer.TREE: [], mcap_writer.EVENTS: []}, "players offer what is usual"


def logged(file: Path) -> list[tuple[float, int, str, str]]:
    with file.open("rb") as opened:
        found = make_reader(opened).iter_messages(topics=[mcap_writer.EVENTS])
        read = [(m.log_time, deserialize_message(m.data, message_class(mcap_writer.EVENTS_TYPE))) for _, _, m in found]
    for at, log in read:
        assert log.stamp.sec * 1_000_000_000 + log.stamp.nanosec == at
    return [(at / 1e9 - FAILED, log.level, log.name, log.msg) for at, log in read]


def test_events_and_moments_are_recorded_in_order(file: Path) -> None:
    records = logged(file)
    assert [(level, name, text) for _, level, name, text in records] == [
        (30, "RobotWorkload/robot-1-drive", "FailureDetected: so"),
        (30, "recovery", f"detected: {REASON}"),
        (20, "recovery", "routed"),
        (20, "RobotWorkload/robot-1-drive", "Recovered: so"),
    ]
    assert [at for at, *_ in records] == pytest.approx([-0.25, 0.0, 0.01, 0.75], abs=1e-5)


def test_the_tree_is_recorded_according_to_its_schema(file: Path) -> None:
    with file.open("rb") as opened:
        (message,) = [m for _, _, m in make_reader(opened).iter_messages(topics=[mcap_writer.TREE])]
    with file.open("rb") as opened:
        attachments = {a.name: json.loads(a.data) for a in make_reader(opened).iter_attachments()}
    trace = Trace.model_validate_json(deserialize_message(message.data, message_class(mcap_writer.TREE_TYPE)).data)
    assert trace.tree is not None
    assert trace.tree.children[0].reason == REASON
    assert attachments["tree.schema.json"] == Trace.model_json_schema()
    assert attachments["recovery.json"] == recovery().to_wire()
    assert [one["reason"] for one in attachments["events.json"]] == ["FailureDetected", "Old", "Recovered"]


def test_the_metadata_contains_the_recovery_and_the_omitted_topics(file: Path) -> None:
    with file.open("rb") as opened:
        (metadata,) = make_reader(opened).iter_metadata()
    assert metadata.name == "understudy"
    assert metadata.metadata.items() >= {
        "namespace": "fleet", "workload": "robot-1-drive", "recovery": "abc", "number": "3", "reason": REASON,
        "failed": "2026-05-28T20:27:10.250000Z", "strategy": "Fallback/Executing", "leftOut": '{"/image": "too much"}',
    }.items()  # fmt: skip
