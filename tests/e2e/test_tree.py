"""The live tree of a workload that runs, asked for as a user would."""

from __future__ import annotations

import json

from tests.e2e.console import understudy
from tests.e2e.scenario import Robot, eventually


def live(robot: Robot) -> str | None:
    """What is shown, once the tree is healthy: a machine that is busy with the robot's start may be slow to answer."""
    done = understudy(robot.kubectl, "tree", robot.workload)
    if done.returncode != 0:
        return None
    return done.stdout if commands(done.stdout).split()[1] == "healthy" else None


def commands(shown: str) -> str:
    """The line of the tree's only leaf."""
    return next(line for line in shown.splitlines() if line.split()[:1] == ["commands"])


def conditions(robot: Robot) -> dict[str, str]:
    """Those that the live tree comes with, with their status."""
    state = json.loads(understudy(robot.kubectl, "tree", robot.workload, "-o", "json").stdout or "{}")
    return {c["type"]: c["status"] for c in state.get("conditions", [])}


def test_the_live_tree_is_asked_for_through_kubectl(executing: Robot) -> None:
    active = executing.wait_protected()
    shown = eventually(
        lambda: live(executing), within=60, every=2.0, what="the live tree is healthy", note=executing.describe
    )
    assert f"in control: {active} (epoch 1)" in shown
    assert "if it failed now: Executing" in shown
    assert " Hz, " in commands(shown)
    good = {"GateEnforced": "True", "Monitored": "True", "Healthy": "True"}.items()
    eventually(lambda: good <= conditions(executing).items(), within=60, every=2.0, what="all is well by the live tree")
    missing = understudy(executing.kubectl, "tree", "robot-2-drive")
    assert missing.returncode == 2
    assert '"robot-2-drive" not found' in missing.stderr
