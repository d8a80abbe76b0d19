"""kubectl for tests: what a user would type, with the answers as objects."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

Object = dict[str, Any]

TIMEOUT = 60.0
"""Seconds for one command."""

KILLED = 128 + 9
"""What a command exits with that was ended by SIGKILL."""


class Failed(AssertionError):
    """A command ended with an error; the message is what it said."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status
        """What the command exited with."""


class Kubectl:
    """kubectl bound to a kubeconfig and a namespace."""

    def __init__(self, kubeconfig: Path, namespace: str) -> None:
        program = shutil.which("kubectl")
        assert program, "kubectl is not on the PATH: scripts/test puts it there"
        self._program, self.kubeconfig, self.namespace = program, kubeconfig, namespace

    def in_namespace(self, namespace: str) -> Kubectl:
        """The same for another namespace."""
        return Kubectl(self.kubeconfig, namespace)

    def command(self, *arguments: str) -> list[str]:
        """The command line."""
        return [self._program, f"--kubeconfig={self.kubeconfig}", "-n", self.namespace, *arguments]

    def __call__(self, *arguments: str, given: str | None = None, timeout: float = TIMEOUT) -> str:
        """Run a command; its standard output. Raises Failed."""
        done = subprocess.run(
            self.command(*arguments), input=given, capture_output=True, text=True, timeout=timeout, check=False
        )
        if done.returncode:
            raise Failed(
                f"kubectl {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}", done.returncode
            )
        return done.stdout

    def apply(self, objects: Iterable[Object]) -> None:
        """Apply objects as a user's file would be."""
        items = {"apiVersion": "v1", "kind": "List", "items": list(objects)}
        self("apply", "-f", "-", given=json.dumps(items))

    def get(self, kind: str, name: str) -> Object:
        """An object. Raises Failed where it isn't there."""
        found: Object = json.loads(self("get", kind, name, "-o", "json"))
        return found

    def find(self, kind: str, name: str) -> Object | None:
        """An object, or None."""
        text = self("get", kind, name, "-o", "json", "--ignore-not-found")
        return json.loads(text) if text.strip() else None

    def list(self, kinds: str, selector: str = "") -> list[Object]:
        """Objects of one or more kinds (comma separated)."""
        found: list[Object] = json.loads(self("get", kinds, "-o", "json", *(["-l", selector] if selector else [])))[
            "items"
        ]
        return found

    def patch(self, kind: str, name: str, body: Any, *, kind_of_patch: str = "merge") -> None:
        """Patch an object."""
        self("patch", kind, name, f"--type={kind_of_patch}", "-p", json.dumps(body))

    def shell(self, pod: str, container: str, script: str, *arguments: str, timeout: float = TIMEOUT) -> str:
        """Run a shell script in a container."""
        return self("exec", pod, "-c", container, "--", "sh", "-c", script, "sh", *arguments, timeout=timeout)

    def kill(self, pod: str, *command: str, container: str) -> None:
        """Run in a container what kills its processes, which may end the container and with it the command itself."""
        try:
            self("exec", pod, "-c", container, "--", *command)
        except Failed as error:
            if error.status != KILLED:
                raise


def helm(kubeconfig: Path, *arguments: str, timeout: float = 300.0) -> str:
    """Run helm; its standard output. Raises Failed."""
    program = shutil.which("helm")
    assert program, "helm is not on the PATH: scripts/test puts it there"
    command: Sequence[str] = [program, f"--kubeconfig={kubeconfig}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    if done.returncode:
        raise Failed(f"helm {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout
