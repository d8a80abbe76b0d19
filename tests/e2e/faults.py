"""Faults that need no API server: the test that stops it can't ask it to do the rest. For the local provider only."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import eventually

_PROGRAM = Path(__file__).parents[2] / "scripts" / "cluster"


def cluster(*arguments: str) -> str:
    """What scripts/cluster says, of the cluster under test. Raises Failed."""
    done = subprocess.run([str(_PROGRAM), *arguments], capture_output=True, text=True, timeout=240, check=False)
    if done.returncode:
        raise Failed(f"scripts/cluster {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


class ApiServer:
    """The API server of the cluster under test."""

    def __init__(self, kubectl: Kubectl) -> None:
        self._kubectl = kubectl
        self.stopped = False

    def stop(self) -> None:
        """End it; everything else goes on."""
        self.stopped = True
        cluster("api", "stop")

    def start(self) -> None:
        """Start it, and wait until every node is known to be there."""
        cluster("api", "start")

        def ready() -> bool:
            conditions = [n["status"].get("conditions") or [] for n in self._kubectl.list("nodes", "")]
            return all(any((c["type"], c["status"]) == ("Ready", "True") for c in found) for found in conditions)

        eventually(ready, within=90, what="every node is ready again")
        self.stopped = False


def staying(objects: list[Object]) -> list[Object]:
    """The objects with Deployments whose pods stay on a node that isn't ready: after a restart of the API server each node
    may be taken for lost, until it has given a sign of life. The robot isn't what is to fail.
    """
    for item in objects:
        if item["kind"] == "Deployment":
            keys = ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
            item["spec"]["template"]["spec"]["tolerations"] = [{"key": key, "operator": "Exists"} for key in keys]
    return objects


def signal_processes(pod_uid: str, words: str, number: signal.Signals) -> int:
    """Send a signal to the processes of a pod on this machine whose command line has these words; how many there were."""
    found = 0
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if pod_uid not in (entry / "cgroup").read_text():
                continue
            if words not in (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"):
                continue
            os.kill(int(entry.name), number)
            found += 1
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found
