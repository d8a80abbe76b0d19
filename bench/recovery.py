"""Measures recoveries on the real cluster: the four parts of the paper's equation, and the gap that the robot saw, per
strategy.

    scripts/bench recovery [--failures 20] [--how killed|frozen|deleted] [--strategies executing uninitialized restart]

Every failure is real (by default SIGKILL ends the application's process in its pod). Every figure comes from the
monitor's record of packets and samples, or from the robot's own log. The gap includes the timeout, because the robot
had no commands during the timeout either.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import uuid
from pathlib import Path
from statistics import median

from understudy_demo.recovery import PARTS

from bench.results import Report, of_network
from tests.e2e.conftest import install
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, manifest

TIMEOUT = 0.5
"""Seconds of silence that the quickstart's policies treat as a failure, as in the paper's experiment."""

PERIOD = 0.05
"""Seconds between the quickstart's commands."""

GAP_PAST_TIMEOUT = 0.060
"""Maximum of the robot's gap beyond the timeout, in seconds, if a running standby takes over: detection, switch, and one period."""

REST = 3.0
"""Seconds from the end of a recovery to the next failure. Its pods are cleaned up first, because the nodes share
processors."""

EXPECTED = {"executing": "Fallback/Executing", "uninitialized": "Fallback/Uninitialized", "restart": "Restart"}


PAPER = {
    ("executing", "t_detection"): "paper: 500 ms",
    ("executing", "t_cluster"): "paper: 100 ms",
    ("executing", "t_startup"): "paper: 0",
    ("restart", "t_cluster"): "paper: 2900 ms",
}
"""The paper's results with a TurtleBot 4 and Nav2 (its section IV-B)."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=20)
    parser.add_argument("--how", choices=["killed", "frozen", "deleted"], default="killed")
    parser.add_argument("--strategies", nargs="+", choices=list(EXPECTED), default=list(EXPECTED))
    options = parser.parse_args()
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    chosen = [] if options.strategies == list(EXPECTED) else options.strategies
    report = Report(of_network("-".join(["recovery", *chosen]), cluster := enforcer()))
    clusters: dict[str, list[float]] = {}
    for strategy in options.strategies:
        clusters[strategy] = _strategy(report, kubeconfig, strategy, options.failures, options.how)
    if {"executing", "restart"} <= set(clusters):
        ratio = median(clusters["restart"]) / median(clusters["executing"])
        report.figure("t_cluster Restart / Executing, of medians", [ratio], unit="times", limit="paper: 32")
    report.note(
        "paper", "TurtleBot 4 and Nav2: t_detection 500 ms; t_cluster 2.9 s (restart) and 0.1 s (patch), 32 times"
    )
    report.note("failure", f"application {options.how}, timeout {TIMEOUT:g} s, command period {PERIOD * 1000:g} ms")
    report.note("network policies", cluster)
    print(report.table())
    print(report.write())
    return 0 if report.held else 1


def _strategy(report: Report, kubeconfig: Path, strategy: str, failures: int, how: str) -> list[float]:
    """Run the failures of one strategy in a namespace of its own, and return the t_cluster values in seconds."""
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    kubectl("create", "namespace", kubectl.namespace)
    values: dict[str, list[float]] = {}
    unasked = 0
    try:
        robot = Robot(kubectl)
        kubectl.apply(manifest(f"strategies/{strategy}.yaml"))
        kubectl.apply(robot.objects(policy=f"quickstart-{strategy}"))
        for number in range(1, failures + 1):
            pod, earlier, by_itself = rested(robot)
            unasked += by_itself
            robot.fail(pod, how)
            recovery = robot.wait_unobserved(earlier + 1, within=120)
            if recovery.strategy != EXPECTED[strategy]:
                raise SystemExit(f"failure {number} was recovered by {recovery.strategy}: {recovery.attempts}")
            time.sleep(1.0)
            handover = robot.log(tail=2000).handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
            for part in PARTS:
                values.setdefault(f"t_{part}", []).append(recovery.parts[part])
            assert recovery.seconds is not None
            assert handover.gap is not None, "the robot heard the new instance"
            values.setdefault("t_recovery", []).append(recovery.seconds)
            values.setdefault("detection past the timeout", []).append(recovery.parts["detection"] - TIMEOUT)
            values.setdefault("decision to gate enforced", []).append(
                recovery.moments["routed"] - recovery.moments["decided"]
            )
            values.setdefault("robot: gap without commands", []).append(handover.gap)
            values.setdefault("robot: overlap of two pods", []).append(handover.overlap)
            values.setdefault("robot: early commands", []).append(float(len(handover.early)))
            print(
                f"{strategy} {number}/{failures}: recovery {recovery.seconds:.3f} s, gap {handover.gap:.3f} s, "
                f"t_cluster {recovery.parts['cluster'] * 1000:.1f} ms",
                flush=True,
            )
    finally:
        kubectl("delete", "namespace", kubectl.namespace, "--wait=false")
    report.note(f"{strategy}: recoveries of failures that the bench didn't make, left out", str(unasked))
    must = bars(strategy)
    for name, found in values.items():
        counted = name == "robot: early commands"
        shown, unit = (found, "commands") if counted else ([value * 1000 for value in found], "ms")
        report.figure(
            f"{strategy}: {name}", shown, unit=unit, must=must.get(name), limit=PAPER.get((strategy, name), "")
        )
    return values["t_cluster"]


def bars(strategy: str) -> dict[str, dict[str, float]]:
    """Return the bounds of a strategy's figures, in milliseconds."""
    found = {"detection past the timeout": {"p95": 15.0}, "robot: early commands": {"max": 0.0}}
    if strategy == "executing":
        found["t_cluster"] = {"p95": 10.0}
        found["decision to gate enforced"] = {"p95": 15.0}
        found["robot: gap without commands"] = {"p95": (TIMEOUT + GAP_PAST_TIMEOUT) * 1000}
    return found


def rested(robot: Robot) -> tuple[str, int, int]:
    """Return the active pod after a quiet time, the number of recoveries, and how many of them were just now.

    On a busy machine an application may pause for longer than its timeout.
    """
    first = robot.status().get("recoveryCount", 0)
    while True:
        pod, before = robot.wait_protected(), robot.status().get("recoveryCount", 0)
        time.sleep(REST)
        status = robot.status()
        if (status.get("active"), status.get("recoveryCount", 0)) == (pod, before):
            return pod, before, before - first


def enforcer() -> str:
    """Return the engine that enforced the policies."""
    root = Path(__file__).parents[1]
    told = subprocess.run([str(root / "scripts" / "cluster"), "status"], capture_output=True, text=True, check=False)
    return told.stdout.splitlines()[0] if told.returncode == 0 and told.stdout else "the cluster of KUBECONFIG"


if __name__ == "__main__":
    sys.exit(main())
