"""The live tree of a workload that runs, asked for as a user would; and the same tree, watched beside it."""

from __future__ import annotations

import json
from pathlib import Path

from tests.e2e.console import understudy, watching
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


def watched(robot: Robot) -> str | None:
    """What ``understudy watch`` says of the policy in the ROS graph of the monitor's container, once it has found all of it there.

    Without the monitor's profiles: of two processes of a pod only one can have the gated ports.
    """
    policy = robot.kubectl("get", "failurepolicy", "quickstart-executing", "-o", "yaml")
    (monitor,) = (pod["metadata"]["name"] for pod in robot.monitor_pods())
    watch = "env -u FASTRTPS_DEFAULT_PROFILES_FILE python3 -m understudy watch - --for 5s 2>&1"
    script = f'printf %s "$1" | {watch}; echo "ended with $?"'
    said = robot.kubectl.shell(monitor, "monitor", script, policy)
    print(f"\n{said}")
    return said if "it the tree was never healthy" not in said else None


def test_understudy_tree_shows_the_live_tree(executing: Robot, tmp_path: Path) -> None:
    active = executing.wait_protected()
    who = f"active instance: {active} (epoch {executing.status()['gate']['epoch']})"
    shown = eventually(
        lambda: live(executing), within=60, every=2.0, what="the live tree is healthy", note=executing.describe
    )
    assert who in shown
    assert "next strategy: Executing" in shown
    assert " Hz, " in commands(shown)
    good = {"GateEnforced": "True", "Monitored": "True", "Healthy": "True"}.items()
    eventually(lambda: good <= conditions(executing).items(), within=60, every=2.0, what="all is well by the live tree")
    said = eventually(lambda: watched(executing), within=60, what="the policy is watched beside its monitor")
    assert "understudy watch: no failure was detected\n" in said
    assert said.endswith("ended with 0\n")
    with watching(executing.kubectl, tmp_path / "watched", "tree", "-w", executing.workload) as end:
        drawn = tmp_path / "watched"
        eventually(lambda: drawn.read_text().count(who) >= 2, within=60, what="it is drawn again and again")
        assert end() == 0
    missing = understudy(executing.kubectl, "tree", "robot-2-drive")
    assert missing.returncode == 2
    assert '"robot-2-drive" not found' in missing.stderr
