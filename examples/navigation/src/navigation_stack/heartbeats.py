"""Says on a topic that a node is active, so that its loss is noticed also when there is nothing to do."""

from __future__ import annotations

from std_msgs.msg import Header

from navigation_stack.managed import Loop, Managed

PERIOD = 0.2
"""s between two heartbeats."""


class Heartbeat:
    """A topic on which a node's heart beats between ``begin`` and ``stop``. It is made as the node is configured."""

    def __init__(self, node: Managed, topic: str) -> None:
        self._node = node
        self._publisher = node.create_lifecycle_publisher(Header, topic, 1)
        node.at_cleanup(lambda: node.destroy_lifecycle_publisher(self._publisher))

    def begin(self) -> None:
        """Beat from now on."""
        self._loop = Loop(PERIOD, self._beat)

    def stop(self) -> None:
        """End it."""
        self._loop.stop()

    def _beat(self) -> None:
        self._publisher.publish(Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._node.get_name()))
