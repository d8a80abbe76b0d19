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
    where = [f"--namespace={kubectl.namespace}", f"--kubeconfig={kubectl.kubeconfig}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
    done = subprocess.run(
        [sys.executable, "-m", "understudy", command, *arguments, *where],
        capture_output=True, text=True, timeout=60, check=False, env=environment,
    )  # fmt: skip
    print(f"\n{done.stdout}{done.stderr}")
    return done
