"""The manipulation example on the cluster: an arm that is moved from pose to pose while its planner is taken away.

The result is read from the same logs as for navigation; the robot's has commands of joints, each with its step from
the one before, and where the gripper really was.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from understudy_demo.robotview import Command, RobotLog

from tests.e2e.navigation import Goal, Navigator
from tests.e2e.scenario import SIGNAL, eventually

CONTAINER = "manipulation"
MODULE = "manipulation_stack"

CONFIGURATIONS = {
    "restart": "Restart",
    "pod-started": "Fallback/Uninitialized",
    "executing": "Fallback/Executing",
}
"""The paper's three configurations (its section IV-C), by the name of the manifest, and what each recovers by."""

REACHED = 0.01
"""m from a pose at which the gripper is there: the planner's, the servos' and what 10 Hz of a log leave open."""


@dataclass(frozen=True)
class Spot:
    """Where the gripper really was."""

    time: float
    x: float
    y: float
    z: float
    speed: float
    """rad/s of the joint that moves fastest."""


@dataclass
class ArmLog(RobotLog):
    """What the arm wrote down."""

    spots: list[Spot] = field(default_factory=list)
    steps: dict[float, float] = field(default_factory=dict)
    """By the time of a command's reception, its largest step in rad of a joint from the one before."""
    bumps: int = 0

    def largest_step(self, start: float = 0.0, end: float = math.inf) -> float:
        """Of the commands received in a time."""
        return max((step for received, step in self.steps.items() if start <= received < end), default=0.0)


class Manipulator(Navigator):
    """An arm with its planner and a client."""

    EXAMPLE = "manipulation"

    def log(self, tail: int = 0) -> ArmLog:
        script = f"tail -n {tail} /var/log/robot/robot.jsonl" if tail else "cat /var/log/robot/robot.jsonl"
        self._note_hosts()
        log = ArmLog()
        for record in _records(self.kubectl.shell(self.robot_pod(), "robot", script)):
            match record["event"]:
                case "command":
                    source = self._hosts.get(record["source"], record["source"])
                    # The joints' own command is none of a base's.
                    log.commands.append(
                        Command(record["received"], source, record["sequence"], record["sent"], *[0.0] * 6)
                    )
                    log.steps[record["received"]] = record["step"]
                case "arm":
                    log.spots.append(Spot(*(record[name] for name in ("time", "x", "y", "z", "speed"))))
                case "bumped":
                    log.bumps += 1
        return log

    def wait_driving(self, within: float = 60.0, *, beyond: int = 0) -> Goal:
        def moving() -> Goal | None:
            goal = self.tour().running
            turning = any(spot.speed > 0.2 for spot in self.log(tail=40).spots[-3:])
            return goal if goal and goal.number > beyond and turning else None

        goal: Goal = eventually(moving, within=within, what="the arm moves to a pose", note=self.describe)
        return goal

    def distance_to(self, goal: Goal) -> float:
        near = min(self.log().spots, key=lambda spot: abs(spot.time - goal.ended))
        return math.dist((near.x, near.y, near.z), (goal.x, goal.y, goal.z))

    def send_signal(self, pod: str, number: str, *nodes: str) -> None:
        assert not nodes, "the planner is one process"
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", number, MODULE, container=CONTAINER)


def _records(text: str) -> Iterator[dict[str, Any]]:
    for line in text.splitlines():
        if line.startswith("{") and line.endswith("}"):  # the first may be cut off
            yield json.loads(line)
