"""The console script, run as a user would."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
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


def offline(command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``understudy COMMAND``, of one that asks no cluster; what it wrote is printed too."""
    done = subprocess.run(
        [sys.executable, "-m", "understudy", command, *arguments],
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


@contextlib.contextmanager
def watching(kubectl: Kubectl, file: Path, command: str, *arguments: str) -> Iterator[Callable[[], int]]:
    """The same while the context lasts, with what it writes in a file. What is given ends it as Ctrl-C does; its exit status."""
    with (
        file.open("w") as output,
        subprocess.Popen(
            _command(kubectl, command, *arguments), stdout=output, stderr=subprocess.STDOUT, env=_environment()
        ) as running,
    ):

        def end() -> int:
            running.send_signal(signal.SIGINT)
            status = running.wait(30)
            print(f"\n{file.read_text()}")
            return status

        try:
            yield end
        finally:
            if running.poll() is None:
                end()  # killed outright, it would leave behind the kubectl that watches for it


def shell_environment(kubeconfig: Path, folder: Path, *, namespace: str | None = None) -> dict[str, str]:
    """The environment of a user's shell: with ``understudy`` on the PATH, and a kubeconfig of its own, whose namespace may be set."""
    own, programs = folder / "kubeconfig", folder / "bin"
    shutil.copyfile(kubeconfig, own)
    if namespace is not None:
        told = ["kubectl", f"--kubeconfig={own}", "config", "set-context", "--current", f"--namespace={namespace}"]
        subprocess.run(told, check=True, capture_output=True, timeout=30)
    programs.mkdir()
    (programs / "understudy").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m understudy "$@"\n')
    (programs / "understudy").chmod(0o755)
    return _environment() | {"KUBECONFIG": str(own), "PATH": f"{programs}:{os.environ['PATH']}"}


def completed(kubectl: Kubectl, command: str, begun: str, folder: Path) -> list[str]:
    """The completions that a shell gets in kubectl's cluster and namespace, after ``understudy COMMAND`` and the start of a word."""
    line, answer = " ".join(["understudy", *_command(kubectl, command)[3:], begun]), folder / "answer"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    subprocess.run([sys.executable, "-m", "understudy"], timeout=60, check=False, env=_environment() | asked)
    return answer.read_text().split()


def _command(kubectl: Kubectl, command: str, *arguments: str) -> list[str]:
    where = [f"--namespace={kubectl.namespace}", f"--kubeconfig={kubectl.kubeconfig}"]
    return [sys.executable, "-m", "understudy", command, *arguments, *where]


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
