"""The live tree of a workload that runs, asked for as a user would."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot

REPOSITORY = Path(__file__).parents[2]


def understudy(kubectl: Kubectl, *arguments: str) -> subprocess.CompletedProcess[str]:
    where = [f"--namespace={kubectl.namespace}", f"--kubeconfig={kubectl.kubeconfig}"]
    command = [sys.executable, "-m", "understudy", "tree", *arguments, *where]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment)


def test_the_live_tree_is_asked_for_through_kubectl(executing: Robot) -> None:
    active = executing.wait_protected()
    done = understudy(executing.kubectl, executing.workload)
    print(f"\n{done.stdout}")
    assert done.returncode == 0, done.stderr
    assert f"in control: {active} (epoch 1)" in done.stdout
    assert "if it failed now: Executing" in done.stdout
    told = next(line for line in done.stdout.splitlines() if line.split()[:1] == ["commands"])
    assert told.split()[1] == "healthy"
    assert " Hz, " in told
    state = json.loads(understudy(executing.kubectl, executing.workload, "-o", "json").stdout)
    assert {"GateEnforced": "True", "Monitored": "True", "Healthy": "True"}.items() <= {
        c["type"]: c["status"] for c in state["conditions"]
    }.items()
    missing = understudy(executing.kubectl, "robot-2-drive")
    assert missing.returncode == 2
    assert '"robot-2-drive" not found' in missing.stderr
