"""The traffic of a robot: streams of real messages with the jitter of nodes, whose sender can be made to misbehave.

A process publishes some streams in one loop, and records when it stamped and sent each message. The record shows later
whether a message was late because its sender was.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import random
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.roles import answering, end_with_parent, tell

JITTER = 0.05
"""Standard deviation of the time at which a message is sent, in periods; the deviation never exceeds four times that.
"""

REMEMBERED = 15.0
"""Seconds of sending that are recorded."""

BEHIND = 0.1
"""Seconds of delay above which a sender continues from now, as after a stop, instead of sending a burst."""


@dataclass(frozen=True)
class Stream:
    """Messages of one type on a topic."""

    topic: str
    type: str
    hertz: float
    name: str = ""
    """The name of the stream, if a topic has several."""
    frames: tuple[str, str] = ("odom", "base_link")
    """Of a transform: parent and child."""

    @property
    def key(self) -> str:
        """The key of the stream."""
        return self.name or self.topic


class _Sender:
    """One stream and its state."""

    def __init__(self, stream: Stream, publish: Callable[[Any], None], message: Any) -> None:
        self.stream, self.publish, self.message = stream, publish, message
        self.period = 1 / stream.hertz
        self.spoil = ""
        """What is wrong with its messages; empty if nothing is."""
        self.old = 0.0
        """Seconds that its stamps are too old."""
        self.announce = False
        """Whether the next message is to be reported."""
        self.sent: deque[tuple[float, float]] = deque(maxlen=math.ceil(stream.hertz * REMEMBERED))
        """When each message was stamped, and when it had been sent (Unix seconds)."""

    def send(self) -> None:
        fill(self.message, self.stream, self.spoil)
        announced, self.announce = self.announce, False
        begun = time.time()
        _stamp(self.message, begun - self.old)
        self.publish(self.message)
        self.sent.append((begun, time.time()))
        if announced:
            tell("sent", at=begun)


def publish(streams: Sequence[Stream], node: Any, *, answers: Mapping[str, Any] | None = None, seed: int = 0) -> None:
    """Publish streams with a node until killed, and answer requests.

    ``set`` changes a stream: its ``hertz``, its fault (``spoil``), and the age of its stamps (``old``); the next
    message is then reported. ``sends`` returns when its last messages were stamped and sent. ``answers`` adds further
    requests.
    """
    end_with_parent()
    publishers: dict[str, Any] = {}
    senders: dict[str, _Sender] = {}
    for stream in streams:
        cls = message_class(stream.type)
        if stream.topic not in publishers:
            publishers[stream.topic] = node.create_publisher(cls, stream.topic, 10)
        senders[stream.key] = _Sender(stream, publishers[stream.topic].publish, cls())

    def change(asked: Mapping[str, Any]) -> dict[str, Any]:
        sender = senders[asked["stream"]]
        sender.period = 1 / asked.get("hertz", sender.stream.hertz)
        sender.spoil, sender.old = asked.get("spoil", ""), asked.get("old", 0.0)
        sender.announce = True
        return {}

    def sends(asked: Mapping[str, Any]) -> dict[str, Any]:
        return {"sends": list(senders[asked["stream"]].sent)}

    answering({"set": change, "sends": sends, **(answers or {})})
    tell("ready")
    _loop(list(senders.values()), random.Random(seed))


def _loop(senders: Sequence[_Sender], chance: random.Random) -> None:
    now = time.monotonic()
    due = [now + chance.random() * sender.period for sender in senders]
    queue = [(moment, index) for index, moment in enumerate(due)]
    heapq.heapify(queue)
    while True:
        moment, index = heapq.heappop(queue)
        wait = moment - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        sender = senders[index]
        sender.send()
        due[index] += sender.period
        now = time.monotonic()
        if now - due[index] > BEHIND:
            due[index] = now
        jitter = max(-4 * JITTER, min(4 * JITTER, chance.gauss(0, JITTER)))
        heapq.heappush(queue, (due[index] + jitter * sender.period, index))


def work_on_goals(node: Any, *actions: str) -> list[Any]:
    """Publish, as an action's server does, that a goal of each action is being executed. Returns the publishers, which
    must be kept."""
    from action_msgs.msg import GoalStatus, GoalStatusArray
    from rclpy.qos import DurabilityPolicy, QoSProfile

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = []
    for action in actions:
        publisher = node.create_publisher(GoalStatusArray, f"{action}/_action/status", latched)
        publisher.publish(GoalStatusArray(status_list=[GoalStatus(status=GoalStatus.STATUS_EXECUTING)]))
        publishers.append(publisher)
    return publishers


def node(name: str) -> Any:
    """Return a node whose logs go to /rosout only."""
    import rclpy

    with contextlib.suppress(RuntimeError):  # there is a context already
        rclpy.init(args=["--ros-args", "--disable-stdout-logs"])
    return rclpy.create_node(name)


def spin(*nodes: Any) -> None:
    """Process callbacks of nodes in a thread of its own."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    for one in nodes:
        executor.add_node(one)
    threading.Thread(target=executor.spin, daemon=True).start()


# -- messages ----------------------------------------------------------------------------------------------------------


def message_class(type_name: str) -> Any:
    """Return the class of a message, or of an action's feedback."""
    from understudy.ros.runtime import interface_types

    return interface_types.message_class(type_name)


def fill(message: Any, stream: Stream, spoil: str) -> None:
    """Fill in a message's fields, with the fault ``spoil``, if any."""
    if (filler := _FILLERS.get(stream.type)) is not None:
        filler(message, stream, spoil)


def sizes(streams: Iterable[Stream]) -> list[int]:
    """Return the serialized size of each stream's messages, in bytes."""
    from rclpy.serialization import serialize_message

    found = []
    for stream in streams:
        message = message_class(stream.type)()
        fill(message, stream, "")
        found.append(len(serialize_message(message)))
    return found


def _stamp(message: Any, moment: float) -> None:
    """Set the stamps of a message, if it has any."""
    headers = [message.header] if hasattr(message, "header") else []
    headers += [transform.header for transform in getattr(message, "transforms", ())]
    for header in headers:
        header.stamp.sec, header.stamp.nanosec = int(moment), int(moment % 1 * 1e9)


def _scan(message: Any, stream: Stream, spoil: str) -> None:
    if not message.ranges:
        message.header.frame_id, message.range_max = "laser", 12.0
        message.ranges = array("f", [2.0 + math.sin(n / 20) for n in range(360)])


def _image(message: Any, stream: Stream, spoil: str) -> None:
    if not message.data:
        message.header.frame_id, message.encoding = "camera", "rgb8"
        message.width, message.height, message.step = 64, 48, 3 * 64
        message.data = array("B", bytes(3 * 64 * 48))


def _compressed(message: Any, stream: Stream, spoil: str) -> None:
    if not message.data:
        message.header.frame_id, message.format = "camera", "jpeg"
        message.data = array("B", bytes(40_000))  # about the size of a picture of a room with 640 x 480 pixels


def _camera(message: Any, stream: Stream, spoil: str) -> None:
    if not message.d:
        message.header.frame_id, message.distortion_model = "camera", "plumb_bob"
        message.width, message.height, message.d = 640, 480, array("d", [0.0] * 5)


def _joints(message: Any, stream: Stream, spoil: str) -> None:
    if not message.name:
        message.name = [f"joint_{n}" for n in range(6)]
        message.position = message.velocity = message.effort = array("d", [0.1] * 6)


def _transform(message: Any, stream: Stream, spoil: str) -> None:
    if not message.transforms:
        from geometry_msgs.msg import TransformStamped

        transform = TransformStamped()
        transform.header.frame_id, transform.child_frame_id = stream.frames
        message.transforms = [transform]


def _twist(message: Any, stream: Stream, spoil: str) -> None:
    message.linear.x = 0.2


def _battery(message: Any, stream: Stream, spoil: str) -> None:
    message.percentage = 0.05 if spoil else 0.8


def _temperature(message: Any, stream: Stream, spoil: str) -> None:
    message.temperature = 95.0 if spoil else 45.0


def _number(message: Any, stream: Stream, spoil: str) -> None:
    message.data = 2.0 if spoil else 0.1


def _diagnostics(message: Any, stream: Stream, spoil: str) -> None:
    """``spoil`` is the name of the status that reports an error."""
    from diagnostic_msgs.msg import DiagnosticStatus

    names = ("camera: driver", "motors: left", "motors: right", "battery")
    ok, error = DiagnosticStatus.OK, DiagnosticStatus.ERROR
    message.status = [DiagnosticStatus(name=name, level=error if name == spoil else ok) for name in names]


_FILLERS: Mapping[str, Callable[[Any, Stream, str], None]] = {
    "sensor_msgs/msg/LaserScan": _scan,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CameraInfo": _camera,
    "sensor_msgs/msg/CompressedImage": _compressed,
    "sensor_msgs/msg/JointState": _joints,
    "sensor_msgs/msg/BatteryState": _battery,
    "sensor_msgs/msg/Temperature": _temperature,
    "std_msgs/msg/Float32": _number,
    "geometry_msgs/msg/Twist": _twist,
    "tf2_msgs/msg/TFMessage": _transform,
    "diagnostic_msgs/msg/DiagnosticArray": _diagnostics,
}
