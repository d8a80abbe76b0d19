"""Measures handovers on the real cluster, at the robot: how long it has no command, and how long two instances command it.

    scripts/bench handover [--switches 20] [--hertz 200]

Each instance runs on a node of its own, the robot on a third one. The active instance fails because its pod is no longer
ready, and its application still sends: so its last command shows when the gate was closed for it, and the first command of
its standby when the gate was opened for that one. Both ways of `handover` are measured one after the other. All times are
those at which commands arrived at the robot.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import uuid
from dataclasses import dataclass
from pathlib import Path

from understudy_demo.recovery import Recovered
from understudy_demo.robotview import RobotLog

from bench.recovery import EXPECTED, enforcer, rested
from bench.results import Report, of_network
from tests.e2e import handovers
from tests.e2e.conftest import install
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot
from understudy.failover.strategies.steps import CLOSED_FOR

HANDOVERS = ("Switch", "BreakBeforeMake")

STILL_SENDS = 0.1
"""Seconds before the decision within which the last command of the former instance must have arrived. An earlier one shows nothing of
the gate."""

WRITE = 0.015
"""Seconds that one write of the gate takes until it is enforced, at p95 (as the bar of ``scripts/bench recovery``)."""

HEARD = 0.03
"""Seconds from the last packet of the former instance until the monitor has certainly read it: agents send one every 10 ms,
and the monitor reads them every 20 ms."""

READ = 20.0
"""Seconds of the robot's log that are read after a handover."""


@dataclass(frozen=True)
class Passage:
    """What the robot received while control passed from one instance to another."""

    gap: float
    """Seconds from the last command of the former instance to the first one of the next; 0 if both were open."""
    both_open: float
    """Seconds from the first command of the next instance to the last one of the former; 0 if the former sent none after it."""
    early: int
    """Number of commands of the next instance that arrived before the decision."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--switches", type=int, default=20, help="for each handover")
    parser.add_argument("--hertz", type=int, default=200, help="commands of each instance per second")
    options = parser.parse_args()
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    report = Report(of_network("handover", cluster := enforcer()))
    for handover in HANDOVERS:
        _measure(report, kubeconfig, handover, options.switches, options.hertz)
    report.note("failure", "the pod is no longer ready; its application still sends until the pod has been deleted")
    period = f"every {1000 / options.hertz:g} ms"
    report.note("commands", f"{period}; if both are open for less than that, this may not show")
    report.note("network policies", cluster)
    print(report.table())
    print(report.write())
    return 0 if report.held else 1


def _measure(report: Report, kubeconfig: Path, handover: str, switches: int, hertz: int) -> None:
    """Measure one kind of handover in a namespace of its own."""
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    kubectl("create", "namespace", kubectl.namespace)
    found: list[Passage] = []
    left_out = 0
    try:
        robot = Robot(kubectl)
        kubectl.apply(handovers.objects(robot, handover=handover, hertz=hertz))
        while len(found) < switches:
            pod, earlier, _ = rested(robot)
            robot.fail(pod, "unready")
            recovery = robot.wait_recovered(earlier + 1, within=120)
            time.sleep(1.0)
            log = robot.log(tail=round(READ * (hertz + 20)))  # it has odometry too
            is_expected = (recovery.old, recovery.strategy) == (pod, EXPECTED["executing"])
            if (one := passage(log, recovery) if is_expected else None) is None:
                left_out += 1
                print(f"{handover}: {recovery.strategy} of {recovery.old}, {recovery.reason}: left out", flush=True)
                if left_out > switches:
                    raise SystemExit(f"{left_out} handovers showed nothing: {robot.describe()}")
                continue
            found.append(one)
            print(
                f"{handover} {len(found)}/{switches}: gap {one.gap * 1000:.1f} ms, both open {one.both_open * 1000:.1f} ms",
                flush=True,
            )
    finally:
        kubectl("delete", "namespace", kubectl.namespace, "--wait=false")
    must = bars(handover, hertz=hertz)
    for name, values, unit in (
        ("gap", [1000 * one.gap for one in found], "ms"),
        ("both open", [1000 * one.both_open for one in found], "ms"),
        ("early commands", [float(one.early) for one in found], "commands"),
    ):
        report.figure(f"{handover}: {name}", values, unit=unit, must=must.get(name))
    report.note(f"{handover}: left out, because an instance did not send or another failure came first", str(left_out))


def passage(log: RobotLog, recovery: Recovered) -> Passage | None:
    """Return what the robot received during a recovery, or None if one of both instances did not send then."""
    decided = recovery.moments["decided"]
    found = log.handover(recovery.old, recovery.new, switch=decided)
    if found.last_old is None or found.first_new is None or found.last_old < decided - STILL_SENDS:
        return None
    return Passage(max(0.0, found.first_new - found.last_old), found.overlap, len(found.early))


def bars(handover: str, *, hertz: int) -> dict[str, dict[str, float]]:
    """Return the bounds of the figures of a handover, in milliseconds."""
    found = {"early commands": {"max": 0.0}}
    if handover == "BreakBeforeMake":
        found["both open"] = {"max": 0.0}
        found["gap"] = {"p95": 1000 * (CLOSED_FOR + 2 * WRITE + HEARD + 1 / hertz)}
    return found


if __name__ == "__main__":
    sys.exit(main())
