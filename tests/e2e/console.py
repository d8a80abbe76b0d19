"""The console script, run as a user would."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.e2e.kubectl import Kubectl

REPOSITORY = Path(__file__).parents[2]


def understudy(kubectl: Kubectl, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``understudy COMMAND`` in kubectl's cluster and namespace; what it wrote is printed too."""
    done = subprocess.run(
        _command(kubectl, command, *arguments),
        capture_output=True, text=True, timeout=120, check=False, env=_environment(),
    )  # fmt: skip
    print(f"\n{done.stdout}{done.stderr}")
    return done


def started(kubectl: Kubectl, command: str, *arguments: str) -> subprocess.Popen[str]:
    """The same while it runs."""
    return subprocess.Popen(
        _command(kubectl, command, *arguments),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=_environment(),
    )  # fmt: skip


def _command(kubectl: Kubectl, command: str, *arguments: str) -> list[str]:
    where = [f"--namespace={kubectl.namespace}", f"--kubeconfig={kubectl.kubeconfig}"]
    return [sys.executable, "-m", "understudy", command, *arguments, *where]


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
