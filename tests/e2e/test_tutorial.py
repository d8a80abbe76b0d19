"""The tutorial: each of its commands is run as it stands there, and its robot goes on."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.e2e.console import shell_environment
from tests.e2e.kubectl import Kubectl

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "docs" / "tutorial.md"
IMAGE = "localhost/understudy-quickstart:dev"
COMMANDS = re.compile(r"```sh\n(.*?)```", re.DOTALL)
GAP = re.compile(r"no command for ([\d.]+) s")


@pytest.mark.alone  # its times are those of a robot that has the machine for itself
@pytest.mark.usefixtures("kubectl")
def test_the_robot_of_the_tutorial_is_driven_on_after_a_kill_and_after_a_freeze(
    kubeconfig: Path, tmp_path: Path
) -> None:
    environment = shell_environment(kubeconfig, tmp_path) | {"IMAGE": IMAGE}

    def run(commands: str) -> str:
        done = subprocess.run(
            ["bash", "-euxo", "pipefail", "-c", commands],
            cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240, check=False,
        )  # fmt: skip
        print(done.stdout, done.stderr)
        assert done.returncode == 0, commands
        return done.stdout

    *steps, cleanup = COMMANDS.findall(PAGE.read_text())
    try:
        said = [run(step) for step in steps]
        found = Kubectl(kubeconfig, "tugs").get("robotworkload", "tug-drive")["status"]
        assert [recovery["strategy"] for recovery in found["recoveries"]] == ["Fallback/Executing"] * 2
        gaps = [float(gap) for gap in GAP.findall(said[-1])]
        assert 0.5 <= max(gaps) < 2.0, "what it went without is told at the end: that it froze is seen by its silence"
    finally:
        run(cleanup)
