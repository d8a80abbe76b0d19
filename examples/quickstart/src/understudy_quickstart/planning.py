"""Says which way the robot goes: the second of three nodes of which each depends on the one before (see examples/dependent).

A managed node. Where it begins on the round it decides once, when it is activated: after localization was replaced, and may have put
the robot somewhere else, it has to be activated again. Without a pose it has no plan.
"""

from __future__ import annotations

import time

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from understudy_quickstart.pursuit import WAYPOINTS, Circuit
from understudy_quickstart.running import FRESH, run


class Planning(LifecycleNode):
    """Publishes /plan 10 times a second while it is active and /pose comes."""

    def __init__(self) -> None:
        super().__init__("planning")
        self._circuit = Circuit(WAYPOINTS)
        self._pose: PoseStamped | None = None
        self._received = 0.0
        self._first: int | None = None
        self._active = False
        # Of a managed node's own publishers none gives anything while it is not active; this one is asked only then.
        self._plans = Node.create_publisher(self, Path, "/plan", 1)
        self.create_subscription(PoseStamped, "/pose", self._placed, 1)
        self.create_timer(1 / 10, self._plan)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin with the waypoint that comes next from where the robot is by then."""
        self._first, self._active = None, True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Plan no more."""
        self._active = False
        return super().on_deactivate(state)

    def _placed(self, message: PoseStamped) -> None:
        self._pose, self._received = message, time.monotonic()

    def _plan(self) -> None:
        if not self._active or self._pose is None or time.monotonic() - self._received > FRESH:
            return
        if self._first is None:
            place = self._pose.pose.position
            self._first = self._circuit.waypoint_after(self._circuit.nearest(place.x, place.y))
            self.get_logger().info(f"the plan begins with waypoint {self._first}")
        path = Path()
        path.header.stamp = self.get_clock().now().to_msg()
        path.header.frame_id = "map"
        for x, y in (*WAYPOINTS[self._first :], *WAYPOINTS[: self._first]):
            place = PoseStamped()
            place.header = path.header
            place.pose.position.x, place.pose.position.y = x, y
            path.poses.append(place)
        self._plans.publish(path)


def main() -> None:
    """Run the node until it is asked to stop."""
    run(Planning)


if __name__ == "__main__":
    main()
