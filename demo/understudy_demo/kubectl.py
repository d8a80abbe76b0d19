"""kubectl, as a user would call it, so that whatever the demo does can be repeated by hand."""

from __future__ import annotations

import json
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any


class CommandFailed(Exception):
    """A command ended with an error; the message has the command and what it said."""

    def __init__(self, command: Sequence[str], said: str, status: int | None = None) -> None:
        super().__init__(f"{shlex.join(command)}: {said.strip()[-2000:] or 'failed without a word'}")
        self.said = said
        self.status = status
        """What it exited with; None where it did not get that far."""


def run(
    command: Sequence[str],
    environment: Mapping[str, str],
    *,
    stdin: str | None = None,
    timeout: float = 120.0,
    show: bool = False,
) -> str:
    """Run a command and return its standard output.

    ``show`` lets it write to the terminal instead. Raises CommandFailed, also after ``timeout`` seconds.
    """
    try:
        done = subprocess.run(
            command,
            env=dict(environment),
            input=stdin,
            text=True,
            timeout=timeout,
            check=False,
            stdout=None if show else subprocess.PIPE,
            stderr=None if show else subprocess.PIPE,
        )
    except FileNotFoundError as error:
        raise CommandFailed(command, f"there is no {command[0]}") from error
    except subprocess.TimeoutExpired as error:
        raise CommandFailed(command, f"not done within {timeout:g} s") from error
    if done.returncode != 0:
        raise CommandFailed(command, (done.stderr or done.stdout or "") if not show else "see above", done.returncode)
    return done.stdout or ""


class Kubectl:
    """kubectl in one namespace."""

    def __init__(self, namespace: str, environment: Mapping[str, str]) -> None:
        self.namespace = namespace
        self._environment = environment

    def __call__(self, *arguments: str, stdin: str | None = None, timeout: float = 60.0) -> str:
        """Run it; its standard output."""
        return run(["kubectl", "-n", self.namespace, *arguments], self._environment, stdin=stdin, timeout=timeout)

    def get(self, *arguments: str) -> dict[str, Any]:
        """An object or a list of them; empty if there is none."""
        text = self("get", *arguments, "-o", "json", "--ignore-not-found")
        found: dict[str, Any] = json.loads(text) if text.strip() else {}
        return found
