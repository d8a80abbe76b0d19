"""Has the arm take poses: ``python -m manipulation_client --goals 6``.

One JSON record a line goes to standard output and to the file that MANIPULATION_CLIENT_LOG names; the exit status is 0 when
every goal succeeded.
"""

from __future__ import annotations

import sys
from typing import Any

from manipulation_arm import Pose, places
from manipulation_interfaces.action import MoveToPose
from navigation_client import running
from navigation_client.client import Client


class Poser(Client):
    """Works through a list of poses."""

    NAME, ACTION, TYPE = "manipulation_client", "/move_to_pose", MoveToPose

    def described(self, goal: Pose) -> dict[str, float]:
        return {"x": goal.x, "y": goal.y, "z": goal.z}

    def message(self, goal: Pose) -> Any:
        message = MoveToPose.Goal()
        message.pose.header.frame_id = "base_link"
        message.pose.header.stamp = self._node.get_clock().now().to_msg()
        place, turned = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = goal.x, goal.y, goal.z
        turned.w, turned.x, turned.y, turned.z = goal.qw, goal.qx, goal.qy, goal.qz
        return message


def main() -> int:
    """Send the goals; returns the exit status."""
    return running.run(Poser, running.parser(Poser, __doc__), lambda told: list(places(told.goals)))


if __name__ == "__main__":
    sys.exit(main())
