"""What is run in a container to make it fail, in a process namespace of its own: as in a pod, number 1 is shielded."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from itertools import pairwise
from typing import Any

import pytest

from understudy.cli.inject import fault_commands

_UNSHARE = ["unshare", "--map-root-user", "--pid", "--fork", "--mount-proc", "--kill-child"]


def _may_unshare() -> bool:
    return (
        shutil.which("unshare") is not None and not subprocess.run([*_UNSHARE, "true"], capture_output=True).returncode
    )


pytestmark = pytest.mark.skipif(not _may_unshare(), reason="takes a process namespace")

CONTAINER = """
import json, subprocess, sys, time
script, undo, arguments, undo_after, length = json.loads(sys.argv[1])
tick = "import time\\nwhile True:\\n    print(time.monotonic(), flush=True)\\n    time.sleep(0.01)"
application = subprocess.Popen([sys.executable, "-c", tick], stdout=subprocess.PIPE, text=True)
application.stdout.readline()
time.sleep(0.5)
begun = time.monotonic()
done = subprocess.run(["sh", "-c", script, "sh", *arguments], capture_output=True, text=True)
asked = time.monotonic()
if undo_after is not None:
    time.sleep(undo_after)
    subprocess.run(["sh", "-c", undo, "sh", *done.stdout.split()])
time.sleep(length)
ended = time.monotonic()
application.kill()
ticks = [float(line) for line in application.communicate()[0].split()]
print(json.dumps([begun, asked, ended, ticks, done.stdout, done.stderr]))
"""


def made(length: float, percent: int, *, observed: float, undo_after: float | None = None) -> dict[str, Any]:
    """A fault in a container with one application that ticks a hundred times a second."""
    arguments = [f"{value:g}" for value in fault_commands.cycles(length, percent)]
    script_input = json.dumps([fault_commands.FREEZE_AND_SLOW, fault_commands.UNDO, arguments, undo_after, observed])
    done = subprocess.run(
        [*_UNSHARE, sys.executable, "-c", CONTAINER, script_input],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    started_at, asked, ended, ticks, ps_lines, error = json.loads(done.stdout)
    assert error == ""
    assert len(ps_lines.split()) == 2, "the process that undoes it, and the application"
    return {
        "gap": max(later - earlier for earlier, later in pairwise([t for t in ticks if t > started_at - 0.1])),
        "during": sum(asked < tick < asked + length for tick in ticks) / length,
        "before": sum(started_at - 0.4 < tick < started_at for tick in ticks) / 0.4,
        "last": ended - max(ticks),
    }


def test_a_frozen_application_continues_by_itself() -> None:
    run = made(1.0, 100, observed=3.0)
    assert 0.9 < run["gap"] < 2.5
    assert run["last"] < 0.5


def test_a_slow_application_gets_a_part_of_the_time() -> None:
    run = made(2.0, 80, observed=2.5)
    assert 0 < run["during"] < run["before"] / 1.5
    assert run["gap"] < 1.5, "never for long"
    assert run["last"] < 0.5


def test_a_fault_can_be_ended_at_once() -> None:
    run = made(30.0, 100, observed=2.0, undo_after=0.3)
    assert run["gap"] < 2.0
    assert run["last"] < 0.5
    assert made(30.0, 80, observed=2.0, undo_after=0.3)["last"] < 0.5


def test_a_container_with_only_process_1_is_reported() -> None:
    done = subprocess.run(
        [*_UNSHARE, "sh", "-c", fault_commands.FREEZE_AND_SLOW, "sh", "1", "1", "0"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "it has only process 1" in done.stderr
    assert "shareProcessNamespace: true" in done.stderr
