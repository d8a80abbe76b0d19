"""Runs other programs. Errors contain the command line and its output."""

import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path


class CommandFailed(RuntimeError):
    """A program ended with an error."""

    def __init__(self, command: Sequence[str], code: int, output: str) -> None:
        tail = "\n".join(output.strip().splitlines()[-15:])
        super().__init__(f"`{shlex.join(command)}` ended with {code}" + (f":\n{tail}" if tail else ""))
        self.code = code
        self.output = output


def run(
    *command: str | Path,
    check: bool = True,
    env: Mapping[str, str] | None = None,
    input: str | None = None,
    cwd: Path | None = None,
    timeout: float | None = None,
) -> str:
    """Run a program and return its standard output.

    Args:
        check: whether to raise an error if the program's exit code is not 0.
        env: variables in addition to this process's own.
        input: text for the program's standard input, which is empty otherwise.
        timeout: seconds after which the program is killed.

    Raises:
        CommandFailed: the program is missing, was killed, or its exit code was not 0.
    """
    words = [str(word) for word in command]
    try:
        done = subprocess.run(
            words,
            input=input if input is not None else "",
            capture_output=True,
            text=True,
            errors="replace",
            cwd=cwd,
            timeout=timeout,
            env={**os.environ, **env} if env else None,
        )
    except FileNotFoundError:
        raise CommandFailed(words, 127, f"{words[0]}: no such program") from None
    except subprocess.TimeoutExpired:
        raise CommandFailed(words, 124, f"no end within {timeout:g} s") from None
    if check and done.returncode != 0:
        raise CommandFailed(words, done.returncode, done.stdout + done.stderr)
    return done.stdout


def succeeds(*command: str | Path, timeout: float = 20) -> bool:
    """Return whether a program exists and ends with 0 in time."""
    try:
        run(*command, timeout=timeout)
    except CommandFailed:
        return False
    return True


def run_logged(
    command: Sequence[str | Path], log: Path, env: Mapping[str, str] | None = None, cwd: Path | None = None
) -> None:
    """Run a program that takes minutes, with its output in a file.

    Raises:
        CommandFailed: with the end of the output.
    """
    words = [str(word) for word in command]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as out:
        done = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            cwd=cwd,
            env={**os.environ, **env} if env else None,
        )
    if done.returncode != 0:
        raise CommandFailed(words, done.returncode, f"{log.read_text(errors='replace')}\n(whole output: {log})")
