"""Starts and finds the cluster's long-running programs.

There are no pid files: a program is found by its control group and its command line. So programs of an interrupted run
are found too, and another process with a reused id is never mistaken for one of them.
"""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from testcluster.local import cgroups, slices


def command_line(pid: int) -> list[str]:
    """Return the words with which a process was started; empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").rstrip("\0").split("\0")
    except OSError:
        return []


def find(group: str, *words: str) -> int | None:
    """Return the process of a group whose command line contains these words in a row; None if there is none."""
    for pid in sorted(cgroups.pids(group)):
        line = command_line(pid)
        if any(line[start : start + len(words)] == list(words) for start in range(len(line))):
            return pid
    return None


def init_of(group: str) -> int | None:
    """Return the process of a group that is the first of its own process-id namespace, as a node's is; None if there is
    none."""
    for pid in sorted(cgroups.pids(group)):
        try:
            status = Path(f"/proc/{pid}/status").read_text()
        except OSError:
            continue
        for line in status.splitlines():
            if line.startswith("NSpid:") and line.split()[2:] == ["1"]:
                return pid
    return None


def start(group: str, command: Sequence[str | Path], log: Path, *, prompt: bool = False) -> int:
    """Start a program in a group, detached from this process, append its output to a file, and return its process id.

    ``prompt`` programs run as soon as they are woken, even where every processor is busy.
    """
    log.parent.mkdir(parents=True, exist_ok=True)

    def enter() -> None:
        cgroups.join(group)
        if prompt:
            slices.shorten()
        os.setsid()

    with log.open("ab") as out:
        # Proxies are for outside networks, and these programs only reach each other.
        environment = {name: value for name, value in os.environ.items() if not name.lower().endswith("_proxy")}
        if prompt:
            # Collect garbage less often, at the cost of memory: one collection uses a processor for 50 ms.
            environment.setdefault("GOGC", "400")
        return subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            preexec_fn=enter,
            env=environment,
            cwd="/",
        ).pid
