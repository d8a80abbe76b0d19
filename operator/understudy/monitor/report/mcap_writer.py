"""Writes the recording of a failure: an MCAP file in the form of rosbag2, which every ROS tool opens.

All its messages are CDR, because rosbag2 does not play files with other encodings. So Understudy's own data are ROS messages too: the
health tree is JSON in a std_msgs/msg/String, and the moments and Events are rcl_interfaces/msg/Log.
"""

from __future__ import annotations

import heapq
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from pydantic import TypeAdapter

from understudy import __version__
from understudy.api.base import Model
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.moments import unix
from understudy.kube.client import Object
from understudy.ros.observe.offered_qos import offers
from understudy.ros.observe.sample_rings import Message, RecordedTopic
from understudy.ros.runtime.interface_types import TypeNotInstalled, message_class
from understudy.ros.runtime.type_definitions import definition
from understudy.trees.core.snapshots import Shown

TREE, TREE_TYPE = "/understudy/tree", "std_msgs/msg/String"
"""Topic and type of the health tree, which is recorded whenever a node changed, and once a second."""

EVENTS, EVENTS_TYPE = "/understudy/events", "rcl_interfaces/msg/Log"
"""Topic and type of the moments of the recovery, and of the Events of the objects concerned."""

_INFO, _WARN = 20, 30  # rcl_interfaces/msg/Log

BATCH, REST = 20, 0.0005
"""Messages that are written at a time, and pause after them in seconds: the monitor's loop must not wait for this thread."""


class Node(Model):
    """A node of the health tree at a moment."""

    name: str
    kind: str
    state: Shown
    reason: str
    topic: str | None = None
    received: int | None = None
    """For a leaf: number of messages of its topic that have counted so far."""
    age: float | None = None
    """For a leaf: seconds since the last of these messages."""
    task: str | None = None
    children: list[Node] = field(default_factory=list)


class Trace(Model):
    """A message of TREE."""

    time: float
    """Unix seconds."""
    health: str
    active: str
    """The active pod."""
    epoch: int
    """Epoch of the gate."""
    tree: Node | None


@dataclass(frozen=True)
class Content:
    """The content of a recording."""

    namespace: str
    workload: str
    recovery: Recovery
    tracks: Sequence[RecordedTopic]
    events: Sequence[Object]
    """Kubernetes Events of the objects concerned."""
    offers: Mapping[str, str]
    """The QoS that the publishers of each topic offer, by topic, in the format of understudy.ros.observe.offered_qos."""
    since: float
    """Start of the recording (Unix seconds)."""
    notes: Mapping[str, str]
    """Further metadata, such as what is missing."""


def write(file: IO[bytes], content: Content) -> int:
    """Write a recording. Returns the number of messages. Slow: call it in a thread. Raises OSError."""
    from mcap.writer import Writer  # imported only here, because a monitor needs it only after a failure

    writer = Writer(file)
    writer.start(profile="ros2", library=f"understudy {__version__}")
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    tracks = [*content.tracks, RecordedTopic(EVENTS, EVENTS_TYPE, list(_event_log(content)))]
    for track in tracks:
        if track.type not in schemas:
            try:
                text = definition(track.type)
            except TypeNotInstalled:  # the type was installed when the message was received
                text = ""
            schemas[track.type] = writer.register_schema(track.type, "ros2msg", text.encode())
        # The ros2 profile requires this field. If the QoS is unknown, it is empty, and players offer the default.
        offered = {"offered_qos_profiles": content.offers.get(track.topic) or offers([])}
        channels[track.topic] = writer.register_channel(track.topic, "cdr", schemas[track.type], offered)
    count = 0
    for count, (channel, (received, sent, sequence, data)) in enumerate(_in_order(tracks, channels), 1):
        at = _nanoseconds(received)
        writer.add_message(channel, at, data, _nanoseconds(sent) if sent > 0 else at, sequence & 0xFFFFFFFF)
        if not count % BATCH:
            time.sleep(REST)
    moment = _nanoseconds(unix(content.recovery.moments.detected) or content.since)
    for name, attachment in _attachments(content).items():
        writer.add_attachment(moment, moment, name, "application/json", json.dumps(attachment, indent=2).encode())
    writer.add_metadata("understudy", _metadata(content))
    writer.finish()  # type: ignore[no-untyped-call]
    return count


def _in_order(tracks: Sequence[RecordedTopic], channels: Mapping[str, int]) -> Iterator[tuple[int, Message]]:
    """Yield all messages, oldest first, each with its channel."""
    streams = ([(channels[track.topic], message) for message in track.messages] for track in tracks)
    return heapq.merge(*streams, key=lambda found: found[1][0])


def _attachments(content: Content) -> dict[str, Any]:
    return {
        "recovery.json": content.recovery.to_wire(),
        "events.json": list(content.events),
        "tree.schema.json": TypeAdapter(Trace).json_schema(),
    }


def _metadata(content: Content) -> dict[str, str]:
    recovery = content.recovery
    return {
        "version": __version__,
        "namespace": content.namespace,
        "workload": content.workload,
        "recovery": recovery.id,
        "number": str(recovery.number),
        "reason": recovery.reason,
        "result": recovery.result,
        "strategy": recovery.strategy,
        "failed": recovery.moments.detected or "",
        **content.notes,
    }


def _event_log(content: Content) -> Iterator[Message]:
    """Yield moments and Events as messages of EVENTS, oldest first."""
    found = [*_moments(content.recovery), *_events(content)]
    for number, (at, level, name, text) in enumerate(sorted(found, key=lambda one: one[0]), 1):
        yield at, at, number, _log(at, level, name, text)


def _moments(recovery: Recovery) -> Iterator[tuple[float, int, str, str]]:
    for name, moment in recovery.moments.to_wire().items():
        if (at := unix(moment)) is not None:
            text = f"{name}: {recovery.reason}" if name == "detected" else name
            yield at, _WARN if name == "detected" else _INFO, "recovery", text


def _events(content: Content) -> Iterator[tuple[float, int, str, str]]:
    for event in content.events:
        at = unix(event.get("lastTimestamp") or event.get("eventTime") or event["metadata"].get("creationTimestamp"))
        if at is not None and at >= content.since - 1:  # times of Events are in whole seconds
            about = event["involvedObject"]
            level = _WARN if event.get("type") == "Warning" else _INFO
            name = f"{about.get('kind', '')}/{about.get('name', '')}"
            yield at, level, name, f"{event.get('reason', '')}: {event.get('message', '')}"


def _log(at: float, level: int, name: str, text: str) -> bytes:
    message = message_class(EVENTS_TYPE)()
    message.stamp.sec, message.stamp.nanosec = divmod(_nanoseconds(at), 1_000_000_000)
    message.level, message.name, message.msg = level, name, text
    return serialized(message)


def text(value: str) -> bytes:
    """Return a text as a serialized message of TREE_TYPE."""
    return serialized(message_class(TREE_TYPE)(data=value))


def serialized(message: Any) -> bytes:
    """Return a message as CDR, with the encapsulation header."""
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)
