"""Common parts of the benches of the paper's experiments: robots on one long tour that lose what drives them
repeatedly."""

from __future__ import annotations

import argparse
import os
import sys
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

from understudy_demo.recovery import PARTS, Recovered
from understudy_demo.robotview import Handover

from bench import bars
from bench.cpu import Container, Sampler
from bench.recovery import enforcer
from bench.results import HERE, Report
from tests.e2e.conftest import install
from tests.e2e.kubectl import Kubectl
from tests.e2e.navigation import Navigator
from tests.e2e.scenario import Late

TIMEOUT = 0.5
"""Seconds without commands that the examples' policies treat as a failure, as in the paper."""

ALLOWED = 0.1
"""Seconds beyond the timeout that the robot may be without commands if a standby executes, at p95."""

WITHIN = 120.0
"""Maximum seconds until the robot moves to a goal again."""

CPU_OVER = 150.0
"""Seconds of the drive over which CPU is averaged, with one failure in them: each restart adds the CPU of a start."""


@dataclass
class Drive:
    """The results of one configuration."""

    recoveries: list[Recovered] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)
    others: dict[str, list[float]] = field(default_factory=dict)
    """Values that only this experiment measures, by name."""
    cpu: dict[str, float] = field(default_factory=dict)
    """Mean milli-CPU by purpose of the pods, over the part of the drive with one failure."""
    goals: int = 0

    def parts(self) -> dict[str, list[float]]:
        return {part: [recovery.parts[part] for recovery in self.recoveries] for part in PARTS}

    def note(self, name: str, value: float) -> None:
        self.others.setdefault(name, []).append(value)


class Experiment(ABC):
    """An experiment: what is driven, and when and how it fails."""

    name: str
    """The name of the bench."""
    container: str
    """The name of the container that drives."""
    robot: type[Navigator]
    configurations: Mapping[str, str]
    """By name, the strategy with which each configuration recovers."""
    labels: Mapping[str, str]
    """The paper's names of the configurations."""

    @abstractmethod
    def far(self, robot: Navigator) -> bool:
        """Return whether the moving robot needs some more time to its goal."""

    @abstractmethod
    def measure(self, robot: Navigator, recovery: Recovered, handover: Handover, drive: Drive) -> str:
        """Note further effects of a recovery on the robot, and describe them in a few words."""

    @abstractmethod
    def report(self, report: Report, name: str, drive: Drive) -> None:
        """Add the figures that only this experiment measures."""

    def compare(self, report: Report, drives: Mapping[str, Drive]) -> None:
        """Add figures to compare with the paper's."""
        cluster = {name: fmean(drive.parts()["cluster"]) for name, drive in drives.items()}
        gaps = {name: fmean(drive.gaps) for name, drive in drives.items()}
        hot = self.labels["executing"]
        report.figure(
            f"t_cluster restart / {hot}, of means",
            [cluster["restart"] / cluster["executing"]],
            unit="times",
            limit="paper: 32",
        )
        report.figure(
            f"down-time at the robot, restart / {hot}, of means",
            [gaps["restart"] / gaps["executing"]],
            unit="times",
            limit="paper: 10; 20 are asked for",
        )
        restart = drives["restart"].cpu.get("stacks", 0.0)
        for name, limit in (("pod-started", "paper: 60 %"), ("executing", "paper: 100 %")):
            extra = drives[name].cpu.get("stacks", 0.0) - restart
            report.figure(f"added CPU of stacks, {self.labels[name]}", [100 * extra / restart], unit="%", limit=limit)


def options(experiment: Experiment, described: str | None) -> argparse.Namespace:
    """Parse the command line."""
    known = list(experiment.configurations)
    parser = argparse.ArgumentParser(description=described, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=20, help="per configuration (default: %(default)s)")
    parser.add_argument(
        "--how",
        choices=["frozen", "killed", "deleted-by-force"],
        default="frozen",
        help="how the stack fails (default: %(default)s, which only missing messages show; the others are reported by the API)",
    )
    parser.add_argument("--configurations", nargs="+", choices=known, default=known)
    return parser.parse_args()


def run(experiment: Experiment, options: argparse.Namespace) -> int:
    """Run all configurations one after the other, and return the exit status. Writes two pictures beside the results."""
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    drives = {name: _drive(kubeconfig, experiment, name, options) for name in options.configurations}
    whole = options.configurations == list(experiment.configurations)
    report = Report(experiment.name if whole else "-".join([experiment.name, *options.configurations]))
    for name, drive in drives.items():
        _report(report, experiment, name, drive)
    if whole:
        experiment.compare(report, drives)
    report.note(
        "failure",
        f"pod or stack {options.how}, timeout {TIMEOUT:g} s; the robot is on its way to a goal at each failure",
    )
    report.note("network policies", enforcer())
    print(report.table())
    print(report.write())
    pictures = HERE / "results"
    bars.recovery_times(
        {experiment.labels[name]: drive.parts() for name, drive in drives.items()},
        pictures / f"{report.name}-times.png",
        title=f"Recovery time per configuration: mean of {options.failures} failures, each a dot",
        references={},
    )
    bars.cpu(
        {experiment.labels[name]: drive.cpu for name, drive in drives.items()},
        pictures / f"{report.name}-cpu.png",
        title=f"Mean CPU over {CPU_OVER:g} s of driving with one failure, by pod",
    )
    return 0 if report.held else 1


def _drive(kubeconfig: Path, experiment: Experiment, configuration: str, options: argparse.Namespace) -> Drive:
    """Run the failures of one configuration on one long drive, in a namespace of its own."""
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    kubectl("create", "namespace", kubectl.namespace)
    drive = Drive()
    try:
        robot = experiment.robot(kubectl)
        robot.set_up(configuration)
        robot.wait_protected()
        robot.send_client(500)  # more goals than the robot will reach
        robot.wait_driving(WITHIN)
        nodes = [node["metadata"]["name"] for node in kubectl.list("nodes")]
        with Sampler(
            nodes, lambda node: kubectl("get", "--raw", f"/api/v1/nodes/{node}/proxy/metrics/resource")
        ) as found:
            end = time.monotonic() + CPU_OVER
            # What the experiment measures runs in the robot's pods and would count.
            _fail_once(experiment, robot, drive, options, configuration, measured=False)
            time.sleep(max(0.0, end - time.monotonic()))
        while len(drive.recoveries) < options.failures:
            _fail_once(experiment, robot, drive, options, configuration, measured=True)
        tour = robot.tour()
        lost = [goal for goal in tour.goals if goal.status not in ("succeeded", "") or goal.asked > 1]
        if lost:
            raise SystemExit(f"goals that were not reached, or asked for twice: {lost}")
        drive.goals = sum(goal.status == "succeeded" for goal in tour.goals)
        drive.cpu = found.usage.milli(lambda container: _group(container, kubectl.namespace, experiment.container))
    except Late as late:
        print(robot.describe(), file=sys.stderr)
        raise SystemExit(str(late)[:2000]) from late
    finally:
        kubectl("delete", "namespace", kubectl.namespace, "--wait=true", timeout=180)
    return drive


def _fail_once(
    experiment: Experiment,
    robot: Navigator,
    drive: Drive,
    options: argparse.Namespace,
    configuration: str,
    *,
    measured: bool,
) -> None:
    """Have the stack fail once while the robot is under way, and note the recovery."""
    number = len(drive.recoveries) + 1
    active = robot.wait_protected()
    _wait_under_way(experiment, robot)
    recovery = _fail(robot, active, options.how, number)
    if recovery.strategy != experiment.configurations[configuration]:
        raise SystemExit(f"failure {number} was recovered by {recovery.strategy}: {recovery.attempts}")
    drive.recoveries.append(recovery)
    handover = robot.log(tail=6000).handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    assert handover.gap is not None, "the robot heard the new instance"
    drive.gaps.append(handover.gap)
    drive.overlaps.append(handover.overlap)
    assert recovery.seconds is not None
    said = f", {experiment.measure(robot, recovery, handover, drive)}" if measured else ""
    print(
        f"{configuration} {number}/{options.failures}: recovery {recovery.seconds:.3f} s, gap {handover.gap:.3f} s{said}",
        flush=True,
    )


def _wait_under_way(experiment: Experiment, robot: Navigator) -> None:
    """Wait until the robot has been moving for two seconds and needs some more time to its goal.

    At a goal the robot stands until the client sends the next one, so missing commands are no failure there.
    """
    end = time.monotonic() + WITHIN
    while True:
        robot.wait_driving(WITHIN)
        time.sleep(2.0)
        robot.wait_driving(WITHIN)
        if experiment.far(robot):
            return
        if time.monotonic() > end:
            raise Late(f"the robot was never far enough from its goal for {WITHIN} s")


def _fail(robot: Navigator, active: str, how: str, number: int) -> Recovered:
    match how:
        case "deleted-by-force":
            robot.delete(active, force=True)
        case "frozen":
            robot.send_signal(active, "STOP")
        case "killed":
            robot.send_signal(active, "KILL")
    return robot.wait_unobserved(number, within=180)


def _group(container: Container, namespace: str, stack: str) -> str | None:
    """Return a container's purpose; None for the robot's simulation and the client, which are not compared."""
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
    return "stacks" if container.name == stack else None


def _report(report: Report, experiment: Experiment, name: str, drive: Drive) -> None:
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
    experiment.report(report, name, drive)
    report.figure(f"{name}: goals reached meanwhile", [drive.goals], unit="goals")
    report.figure(f"{name}: mean CPU in all", [sum(drive.cpu.values())], unit="milli-CPU")
    for group, milli in sorted(drive.cpu.items()):
        report.figure(f"{name}: mean CPU of {group}", [milli], unit="milli-CPU")
