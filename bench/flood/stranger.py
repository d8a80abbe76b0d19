"""The pod from which a flood comes, and a policy that lets it through."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.flood import flooder
from bench.flood.flooder import Plan
from tests.e2e.kubectl import Kubectl, Object

IMAGE = "localhost/understudy-quickstart:dev"

FOLDER = "/opt/flooder"

OPEN = "everything-is-open"

CORE = "core"


class Stranger:
    """A pod without rights and without labels of Understudy."""

    def __init__(self, kubectl: Kubectl, cpu: str) -> None:
        """``cpu`` is its limit, ``none``, or ``core``: all its processes are on the last processor of the machine."""
        self.kubectl, self.name = kubectl, f"stranger-{cpu}"
        self._prefix = ("taskset", "--cpu-list", str((os.cpu_count() or 1) - 1)) if cpu == CORE else ()
        resources: Object = {"requests": {"cpu": "1m"}, "limits": {} if cpu in (CORE, "none") else {"cpu": cpu}}
        program = {"flooder.py": Path(flooder.__file__).read_text()}
        container = {
            "name": "stranger",
            "image": IMAGE,
            "imagePullPolicy": "IfNotPresent",
            "command": ["sleep", "infinity"],
            "resources": resources,
            "volumeMounts": [{"name": "program", "mountPath": FOLDER}],
        }
        spec = {
            "automountServiceAccountToken": False,
            "terminationGracePeriodSeconds": 0,
            "containers": [container],
            "volumes": [{"name": "program", "configMap": {"name": self.name}}],
        }
        common = {"apiVersion": "v1", "metadata": {"name": self.name}}
        kubectl.apply([{**common, "kind": "ConfigMap", "data": program}, {**common, "kind": "Pod", "spec": spec}])
        kubectl("wait", f"pod/{self.name}", "--for=condition=Ready", "--timeout=60s", timeout=70)

    def begin(self, seconds: float) -> Flood:
        """Begin a flood, which has no targets yet."""
        program = (*self._prefix, "python3", f"{FOLDER}/flooder.py", f"{seconds:g}")
        return Flood(self.kubectl.command("exec", "-i", self.name, "--", *program))

    def end(self) -> None:
        self.kubectl("delete", "pod", self.name, "--now", "--ignore-not-found")


class Flood:
    """A flood in progress."""

    def __init__(self, command: Sequence[str]) -> None:
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def aim(self, plan: Plan) -> None:
        """Send to other targets from now on."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(plan.__dict__) + "\n")
        self._process.stdin.flush()

    def result(self, within: float) -> dict[str, float]:
        """Return what was sent, after the flood has ended."""
        out, _ = self._process.communicate(timeout=within)
        found: dict[str, float] = json.loads(out)
        return found

    def end(self) -> None:
        """End it early."""
        self._process.kill()
        self._process.wait()


@contextlib.contextmanager
def opened(kubectl: Kubectl) -> Iterator[None]:
    """Admit everything to all pods of a namespace, as a network does that enforces no policy for what arrives."""
    policy: Any = {"podSelector": {}, "policyTypes": ["Ingress"], "ingress": [{}]}
    kind = {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy"}
    kubectl.apply([{**kind, "metadata": {"name": OPEN}, "spec": policy}])
    try:
        yield
    finally:
        kubectl("delete", "networkpolicy", OPEN)
