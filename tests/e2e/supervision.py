"""The tracker's example on the cluster: a robot with a marker on it, a camera above it, and what the tracker makes of its images.

The result is read from the robot's log (commands with their senders, where it really was), from what the tracker
publishes, and from the workload's status.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from understudy_demo import robotview
from understudy_demo.robotview import Motion, RobotLog

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import CONTAINER, SIGNAL, Late, Robot, eventually

MANIFESTS = Path(__file__).parents[2] / "examples" / "tracker" / "manifests"
APPLICATION = "tracker_application"

FAST = 0.25
"""m/s from which on the robot drives."""

BUSY = {"gap": "3s", "delay": "800ms"}
"""What leaves allow for on a machine that is busy with other things, where one failure is looked at and there should be no other."""

LOOK = """
import json, sys, time
import rclpy
from nav_msgs.msg import Odometry
rclpy.init()
node = rclpy.create_node("look")
found, length, fast, enough, again = [], float(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
def see(m):
    place, twist = m.pose.pose.position, m.twist.twist
    found.append((m.header.stamp.sec + m.header.stamp.nanosec / 1e9, place.x, place.y, twist.linear.x, twist.angular.z))
def drives():
    back = [i for i in range(1, len(found)) if found[i][0] - found[i - 1][0] > 2.0]
    if again and not back:
        return False
    return sum(f[3] > fast for f in found[back[-1] if again else 0:]) >= enough
node.create_subscription(Odometry, "/tracker/robot/odometry", see, 10)
end = time.monotonic() + length
while time.monotonic() < end and not drives():
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps(found))
"""
"""Run in the tracker's pod: what it says of the robot until that was seen to drive often enough, if need be again after it wasn't seen
for a while; or for so many seconds."""


@dataclass(frozen=True)
class Sighting:
    """What the tracker published once."""

    stamp: float
    """When the image was taken, unix seconds."""
    x: float
    y: float
    forward: float
    turn: float


class Supervised(Robot):
    """A robot that a camera looks at."""

    def __init__(self, kubectl: Kubectl) -> None:
        super().__init__(kubectl, "robot-1")

    def set_up(self, strategies: slice) -> None:
        """Apply all of the example, with some of the strategies of its policy."""
        found: list[Object] = [
            item
            for name in ("policy.yaml", "workload.yaml", "robot.yaml", "tracker.yaml")
            for item in yaml.safe_load_all((MANIFESTS / name).read_text())
            if item
        ]
        (policy,) = [item["spec"] for item in found if item["kind"] == "FailurePolicy"]
        policy["strategies"] = policy["strategies"][strategies]
        for leaf in policy["monitoring"]["yaml"]["parallel"]:
            for kind, key in (("topic", "gap"), ("motion", "delay")):
                if kind in leaf:
                    leaf[kind][key] = BUSY[key]
        if not any("poolRef" in strategy for strategy in policy["strategies"]):
            found = [item for item in found if item["kind"] != "FallbackPool"]
        self.kubectl.apply(found)

    def log(self, tail: int = 0) -> RobotLog:
        """What the robot wrote down."""
        return robotview.parse(self.kubectl("logs", f"deployment/{self.name}", "-c", "robot", f"--tail={tail or -1}"))

    def look(self, within: float, *, driving: int, again: bool = False) -> list[Sighting]:
        """What the tracker says of the robot until that was seen driving so many times, ``again`` after it was out of the picture."""
        said = self.kubectl(
            "exec", "deployment/tracker", "--", "python3", "-c", LOOK, f"{within:g}", f"{FAST:g}", str(driving),
            str(int(again)), timeout=within + 60,
        )  # fmt: skip
        found = [Sighting(*entry) for entry in json.loads(said.splitlines()[-1])]
        if (times := sum(sighting.forward > FAST for sighting in found)) < driving:
            raise Late(
                f"not within {within:g} s: the robot is seen to drive {driving} times, but {times}. {self.describe()}"
            )
        return found

    def wait_straight(self, within: float = 120.0) -> None:
        """Wait until the robot has just set out on the leg that is wholly in the picture."""

        def straight() -> bool:
            now: Sequence[Motion] = self.log(tail=20).motions[-1:]
            return any(m.speed > FAST and m.y < 0.0 and -0.5 < m.x < 0.1 for m in now)

        eventually(straight, within=within, what="the robot drives in the picture", every=0.1, note=self.describe)

    def misremap(self, pod: str) -> None:
        """Have the input of what hands commands to the robot remapped wrongly, in the running application of a pod."""
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", "USR1", APPLICATION, container=CONTAINER)
