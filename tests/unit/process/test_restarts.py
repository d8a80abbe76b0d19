"""A process that crashes is started again at once, and by nobody else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

SCRIPT = """
import asyncio, os, signal, sys
from understudy.process import restarts

restarts.STEADY = float(sys.argv[1])

async def run():
    restarts.end_with_parent()
    stopping = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopping.set)
    print(os.getpid(), flush=True)
    await stopping.wait()
    print("stopped", flush=True)

def work():
    exec(sys.argv[2])

sys.exit(restarts.keep_running(work))
"""


@contextmanager
def running(work: str = "asyncio.run(run())", steady: float = 0.0) -> Iterator[subprocess.Popen[str]]:
    """A process that keeps another one running, which prints its ID."""
    command = [sys.executable, "-c", SCRIPT, str(steady), work]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_a_process_that_crashes_is_started_again_each_time() -> None:
    with running() as process:
        pids = []
        for _ in range(5):
            pids.append(int(line(process)))
            os.kill(pids[-1], signal.SIGKILL)
        assert len({process.pid, *pids}) == 6


def test_sigterm_reaches_the_process_and_ends_both() -> None:
    with running() as process:
        line(process)
        process.terminate()
        assert line(process) == "stopped"
        assert process.wait(20) == 0


def test_a_process_ends_with_the_one_that_keeps_it_running() -> None:
    with running() as process:
        line(process)
        process.kill()
        assert line(process) == "", "its end of the pipe is closed"


@pytest.mark.parametrize(
    ("work", "code"), [("sys.exit(3)", 3), ("os.kill(os.getpid(), signal.SIGKILL)", 137), ("1 / 0", 1), ("pass", 0)]
)
def test_a_process_that_cannot_run_is_not_started_again(work: str, code: int) -> None:
    with running(work, steady=60.0) as process:
        assert process.wait(20) == code
