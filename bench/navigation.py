"""The paper's first experiment: recovery times and CPU of its five configurations, during a drive through goals.

    scripts/bench navigation [--failures 20] [--how frozen|killed|deleted-by-force] [--configurations restart executing ...]

In each configuration the robot drives from goal to goal until its stack has failed --failures times. The parts of
the recovery time (the paper's equation 1) come from the monitor's record of packets and samples, the gap from the
robot's own log, and the CPU from the kubelets' counters over a drive with one failure (the paper's sigma(CPU)). The bench
writes two pictures next to the results. It needs a cluster (KUBECONFIG).
"""

from __future__ import annotations

import math
import sys
from typing import ClassVar

from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Handover

from bench import tours
from bench.results import Report
from tests.e2e.navigation import CONFIGURATIONS, Navigator

FAR = 1.5
"""Minimum metres to the goal at which the stack is lost: some seconds of driving."""


class Navigation(tours.Experiment):
    name = container = "navigation"
    robot: type[Navigator] = Navigator
    configurations = CONFIGURATIONS
    labels: ClassVar = {
        "restart": "restart",
        "pod-started": "pod started",
        "stack-started": "stack started",
        "localization-running": "localization running",
        "executing": "full navigation",
    }

    def far(self, robot: Navigator) -> bool:
        goal, here = robot.tour().running, robot.log(tail=20).motions[-1]
        return goal is not None and math.hypot(here.x - goal.x, here.y - goal.y) > FAR

    def measure(self, robot: Navigator, recovery: Recovered, handover: Handover, drive: tours.Drive) -> str:
        drive.note("localization", error := robot.localization_error(recovery.new))
        return f"localization off by {error:.2f} m"

    def report(self, report: Report, name: str, drive: tours.Drive) -> None:
        errors = drive.others["localization"]
        report.figure(f"{name}: localization error after hand-over", errors, unit="m", must={"max": 0.3})


if __name__ == "__main__":
    sys.exit(tours.run(Navigation(), tours.options(Navigation(), __doc__)))
