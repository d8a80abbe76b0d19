"""A topic on which processes of Understudy exchange texts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.served_node import ServedNode, ignore_message

_TYPE = "std_msgs/msg/String"
_QOS = QoSProfile(depth=10)


class TextTopic:
    """Publishes texts on one topic, and receives those of all its publishers, also its own."""

    def __init__(self, served: ServedNode, topic: str, on_received: Callable[[str], None]) -> None:
        """``on_received`` is called in the event loop. Raises TypeNotInstalled."""
        self._served, self._topic, self._on_received = served, topic, on_received
        self._class = message_class(_TYPE)
        self._publisher: Any = None

    async def open(self) -> None:
        """Create the endpoints."""
        await self._served.get(self._open)

    def publish(self, text: str) -> None:
        """Publish a text."""
        self._served.do(lambda: self._publisher.publish(self._class(data=text)))

    def _open(self) -> None:
        node = self._served.node
        self._publisher = node.create_publisher(self._class, self._topic, _QOS)
        subscription = node.create_subscription(self._class, self._topic, ignore_message, _QOS, raw=True)

        def take() -> None:
            with subscription.handle:
                while (sample := self._served.taker.take(subscription.handle.pointer)) is not None:
                    text = str(deserialize_message(sample.data, self._class).data)
                    self._served.call_in_loop(self._on_received, text)

        self._served.add("subscription", subscription, take)
