"""The paper's second experiment: recovery times and CPU of its three configurations, while an arm moves from pose to
pose.

    scripts/bench manipulation [--failures 20] [--how frozen|killed|deleted-by-force] [--configurations restart executing ...]

The method is that of `scripts/bench navigation`. In addition to the paper's figures it measures how far one command
moves the arm: the largest step between two consecutive commands of its joints, as the robot received them, when a
planner takes over and in an undisturbed motion. It needs a cluster (KUBECONFIG).
"""

from __future__ import annotations

import math
import sys
from typing import ClassVar

from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Handover

from bench import tours
from bench.results import Report
from tests.e2e.manipulation import CONFIGURATIONS, Manipulator
from tests.e2e.navigation import Navigator

FAR = 0.2
"""Minimum metres from the gripper to the pose at which the planner is lost: a second of moving."""

AROUND = 2.0
"""Seconds before a failure and after a hand-over in which steps are evaluated."""

STEPS = "largest joint step at the hand-over"
RATIO = "the same by that of undisturbed motion"


class Manipulation(tours.Experiment):
    name = container = "manipulation"
    robot = Manipulator
    configurations = CONFIGURATIONS
    labels: ClassVar = {"restart": "restart", "pod-started": "pod started", "executing": "full execution"}

    def far(self, robot: Navigator) -> bool:
        assert isinstance(robot, Manipulator)
        goal, here = robot.tour().running, robot.log(tail=40).spots[-1]
        return goal is not None and math.dist((here.x, here.y, here.z), (goal.x, goal.y, goal.z)) > FAR

    def measure(self, robot: Navigator, recovery: Recovered, handover: Handover, drive: tours.Drive) -> str:
        assert isinstance(robot, Manipulator)
        assert handover.first_new is not None
        assert handover.last_old is not None
        log = robot.log(tail=6000)
        undisturbed = log.largest_step(handover.last_old - AROUND, handover.last_old)
        step = log.largest_step(handover.first_new, handover.first_new + AROUND)
        drive.note(STEPS, 1000 * step)
        drive.note(RATIO, step / undisturbed)
        return f"largest step {1000 * step:.1f} mrad, {step / undisturbed:.2f} of an undisturbed one"

    def report(self, report: Report, name: str, drive: tours.Drive) -> None:
        report.figure(f"{name}: {STEPS}", drive.others[STEPS], unit="mrad")
        report.figure(f"{name}: {RATIO}", drive.others[RATIO], unit="times", must={"max": 2.0})


if __name__ == "__main__":
    sys.exit(tours.run(Manipulation(), tours.options(Manipulation(), __doc__)))
