"""The paper's first experiment: recovery times and CPU of its five configurations, during a drive through goals.

    scripts/bench navigation [--failures 10] [--how deleted-by-force|frozen|killed] [--configurations restart executing ...]

In each configuration the robot drives from goal to goal for as long as it takes to lose its stack so often. The parts of
the recovery time (the paper's equation 1) are the monitor's record of packets and samples, the gap is the robot's own log,
and the CPU the kubelets' counters over the whole drive (the paper's sigma(CPU)). Writes two pictures beside the results.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

from understudy_demo.recovery import PARTS, Recovered

from bench import bars
from bench.cpu import Container, Sampler
from bench.recovery import enforcer
from bench.results import HERE, Report
from tests.e2e.conftest import install
from tests.e2e.kubectl import Kubectl
from tests.e2e.navigation import CONFIGURATIONS, Navigator
from tests.e2e.scenario import Late

TIMEOUT = 0.5
"""Seconds of silence on /cmd_vel that the example's policies call a failure, as in the paper."""

ALLOWED = 0.1
"""Seconds beyond the timeout that the robot may be without commands where a standby executes, at p95."""

FAR = 1.5
"""Metres to the goal at which the stack is lost, at least: some seconds of driving."""

WITHIN = 120.0
"""Seconds for the robot to be driven to a goal again."""

LABELS = {
    "restart": "restart",
    "pod-started": "pod started",
    "stack-started": "stack started",
    "localization-running": "localization running",
    "executing": "full navigation",
}
"""What the paper calls them."""


@dataclass
class Drive:
    """What one configuration gave."""

    recoveries: list[Recovered] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)
    localization: list[float] = field(default_factory=list)
    cpu: dict[str, float] = field(default_factory=dict)
    """Mean milli-CPU by what the pods are for."""
    goals: int = 0

    def parts(self) -> dict[str, list[float]]:
        return {part: [recovery.parts[part] for recovery in self.recoveries] for part in PARTS}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=10)
    parser.add_argument("--how", choices=["deleted-by-force", "frozen", "killed"], default="deleted-by-force")
    parser.add_argument("--configurations", nargs="+", choices=list(CONFIGURATIONS), default=list(CONFIGURATIONS))
    options = parser.parse_args()
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    drives = {name: _drive(kubeconfig, name, options.failures, options.how) for name in options.configurations}
    whole = options.configurations == list(CONFIGURATIONS)
    report = Report("navigation" if whole else "-".join(["navigation", *options.configurations]))
    for name, drive in drives.items():
        _report(report, name, drive)
    if whole:
        _compare(report, drives)
    report.note(
        "failure", f"pod or stack {options.how}, timeout {TIMEOUT:g} s; the robot drives to a goal at each failure"
    )
    report.note("network policies", enforcer())
    print(report.table())
    print(report.write())
    pictures = HERE / "results"
    bars.recovery_times(
        {LABELS[name]: drive.parts() for name, drive in drives.items()},
        pictures / f"{report.name}-times.png",
        title=f"Recovery time per configuration: mean of {options.failures} failures, each a dot",
        references={},
    )
    bars.cpu(
        {LABELS[name]: drive.cpu for name, drive in drives.items()},
        pictures / f"{report.name}-cpu.png",
        title="Mean CPU over the whole drive, by pod",
    )
    return 0 if report.held else 1


def _drive(kubeconfig: Path, configuration: str, failures: int, how: str) -> Drive:
    """So many failures on one long drive, in a namespace of its own."""
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    kubectl("create", "namespace", kubectl.namespace)
    drive = Drive()
    try:
        navigator = Navigator(kubectl)
        navigator.set_up(configuration)
        navigator.wait_ready()
        navigator.send_client(500)  # more than will be reached
        navigator.wait_driving(WITHIN)
        nodes = [node["metadata"]["name"] for node in kubectl.list("nodes")]
        actives: set[str] = set()
        with Sampler(
            nodes, lambda node: kubectl("get", "--raw", f"/api/v1/nodes/{node}/proxy/metrics/resource")
        ) as found:
            for number in range(1, failures + 1):
                active = navigator.wait_ready()
                actives.add(active)
                _wait_under_way(navigator)
                recovery = _fail(navigator, active, how, number)
                if recovery.strategy != CONFIGURATIONS[configuration]:
                    raise SystemExit(f"failure {number} was recovered by {recovery.strategy}: {recovery.attempts}")
                drive.recoveries.append(recovery)
                drive.localization.append(navigator.localization_error(recovery.new))
                handover = navigator.log(tail=6000).handover(
                    recovery.old, recovery.new, switch=recovery.moments["decided"]
                )
                assert handover.gap is not None, "the robot heard the new instance"
                drive.gaps.append(handover.gap)
                drive.overlaps.append(handover.overlap)
                assert recovery.seconds is not None
                print(
                    f"{configuration} {number}/{failures}: recovery {recovery.seconds:.3f} s, gap {handover.gap:.3f} s, "
                    f"localization off by {drive.localization[-1]:.2f} m",
                    flush=True,
                )
        tour = navigator.tour()
        lost = [goal for goal in tour.goals if goal.status not in ("succeeded", "") or goal.asked > 1]
        if lost:
            raise SystemExit(f"goals that were not reached, or asked for twice: {lost}")
        drive.goals = sum(goal.status == "succeeded" for goal in tour.goals)
        drive.cpu = found.usage.milli(lambda container: _group(container, kubectl.namespace))
    except Late as late:
        print(navigator.describe(), file=sys.stderr)
        raise SystemExit(str(late)[:2000]) from late
    finally:
        kubectl("delete", "namespace", kubectl.namespace, "--wait=true", timeout=180)
    return drive


def _wait_under_way(navigator: Navigator) -> None:
    """Wait until the robot has been driving for two seconds and won't reach its goal at once.

    At a goal it stands until the client sends the next one, with nobody at fault for its having no commands.
    """
    end = time.monotonic() + WITHIN
    while True:
        navigator.wait_driving(WITHIN)
        time.sleep(2.0)
        goal = navigator.wait_driving(WITHIN)
        here = navigator.log(tail=20).motions[-1]
        if math.hypot(here.x - goal.x, here.y - goal.y) > FAR:
            return
        if time.monotonic() > end:
            raise Late(f"the robot was never {FAR} m from its goal for {WITHIN} s")


def _fail(navigator: Navigator, active: str, how: str, number: int) -> Recovered:
    match how:
        case "deleted-by-force":
            navigator.delete(active, force=True)
        case "frozen":
            navigator.send_signal(active, "STOP")
        case "killed":
            navigator.send_signal(active, "KILL")
    return navigator.wait_unobserved(number, within=180)


def _group(container: Container, namespace: str) -> str | None:
    """What a container is for; the robot's simulation and the client aren't part of what is compared."""
    if container.namespace == "understudy-system":
        return "operator"
    if container.namespace != namespace or container.pod.startswith("robot-1-client"):
        return None
    if "-monitor-" in container.pod:
        return "task proxy" if container.name == "tasks" else "monitor"
    if "-discovery-" in container.pod:
        return "discovery server"
    if container.name == "understudy-agent":
        return "agents"
    return "stacks" if container.name == "navigation" else None


def _report(report: Report, name: str, drive: Drive) -> None:
    for part, values in drive.parts().items():
        report.figure(f"{name}: t_{part}", [1000 * value for value in values], unit="ms")
    report.figure(f"{name}: t_recovery", [1000 * (r.seconds or 0.0) for r in drive.recoveries], unit="ms")
    hot = name == "executing"
    report.figure(
        f"{name}: robot: gap without commands",
        [1000 * gap for gap in drive.gaps],
        unit="ms",
        must={"p95": 1000 * (TIMEOUT + ALLOWED)} if hot else None,
    )
    report.figure(
        f"{name}: robot: overlap of two pods", [1000 * gap for gap in drive.overlaps], unit="ms", must={"max": 0}
    )
    report.figure(f"{name}: localization error after hand-over", drive.localization, unit="m", must={"max": 0.3})
    report.figure(f"{name}: goals reached meanwhile", [drive.goals], unit="goals")
    report.figure(f"{name}: mean CPU in all", [sum(drive.cpu.values())], unit="milli-CPU")
    for group, milli in sorted(drive.cpu.items()):
        report.figure(f"{name}: mean CPU of {group}", [milli], unit="milli-CPU")


def _compare(report: Report, drives: dict[str, Drive]) -> None:
    """What the paper found, beside what was found here."""

    cluster = {name: fmean(drive.parts()["cluster"]) for name, drive in drives.items()}
    report.figure(
        "t_cluster restart / full navigation, of means",
        [cluster["restart"] / cluster["executing"]],
        unit="times",
        limit="paper: 32",
    )
    gaps = {name: fmean(drive.gaps) for name, drive in drives.items()}
    report.figure(
        "down-time at the robot, restart / full navigation, of means",
        [gaps["restart"] / gaps["executing"]],
        unit="times",
        limit="paper: 10; 20 are asked for",
    )
    restart = drives["restart"].cpu.get("stacks", 0.0)
    for name, limit in (("pod-started", "paper: 60 %"), ("executing", "paper: 100 %")):
        extra = drives[name].cpu.get("stacks", 0.0) - restart
        report.figure(f"added CPU of stacks, {LABELS[name]}", [100 * extra / restart], unit="%", limit=limit)


if __name__ == "__main__":
    sys.exit(main())
