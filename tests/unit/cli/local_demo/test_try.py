"""``understudy try`` as users run it: real processes, the real mux, and what the robot received."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from understudy.cli.local_demo import command, stand
from understudy.cli.local_demo.course import Demo
from understudy.cli.local_demo.stand import INSTANCES, running
from understudy.cli.local_demo.view import Lines
from understudy.ros.rmw import MIDDLEWARE

pytestmark = pytest.mark.ros

COMMAND = [sys.executable, "-m", "understudy.main", "try"]
GAP = 0.3


def test_the_robot_receives_the_standby_after_a_freeze_and_nothing_of_the_frozen_instance() -> None:
    out = io.StringIO()
    with running(GAP) as processes:
        demo = Demo(processes, Lines(out, time.monotonic()), str, failures=1, freeze_after=1.0, within=2.0)
        demo.run()
    (one,) = demo.failovers
    commands = processes.robot.commands
    before, after = ([c.source for c in commands if (c.at > one.last) is later] for later in (False, True))
    assert set(after) == {one.standby}
    assert before[-1] == one.frozen
    assert {one.frozen, one.standby} == set(INSTANCES)
    assert one.gap is not None
    assert 0 < one.gap < 2.0
    assert max(later.at - earlier.at for earlier, later in pairwise(c for c in commands if c.at >= one.last)) == one.gap
    assert one.leaked == 0
    assert one.sent > 0, "it sends again, and nothing of that is in the robot's record"
    assert processes.monitor.detections[-1].reason.startswith("no /try/cmd_vel for 300 ms")
    assert f"{one.standby} drives: the robot was without commands" in out.getvalue()


def test_a_robot_that_hears_both_instances_has_two_drivers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start = stand.start_process

    def without_gate(folder: Path, name: str, command: list[str], environment: Mapping[str, str]) -> Any:
        profile = {MIDDLEWARE.settings_variable: str(folder / "monitor.xml")} if name == "robot" else {}
        return start(folder, name, command, {**environment, **profile})

    monkeypatch.setattr(stand, "start_process", without_gate)
    assert command.main(["--failures", "1", "--freeze-after", "500ms"]) == 1
    out = capsys.readouterr().out
    assert "TWO DRIVERS" in out
    assert "Never two drivers" not in out


def children(pid: int) -> list[int]:
    found = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [*found, *(other for one in found for other in children(one))]


def lives(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_is_left_when_the_command_ends(number: signal.Signals, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    process = subprocess.Popen([*COMMAND, "--freeze-after=100ms"], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    assert any("is frozen" in line for line in process.stdout), "it never began"
    started = children(process.pid)
    assert len(started) == 6, "a robot, two instances, a monitor, and a mux with the process that starts it again"
    process.send_signal(number)
    process.communicate(timeout=20)
    end = time.monotonic() + 10
    while any(map(lives, started)):
        assert time.monotonic() < end, "a process is left"
        time.sleep(0.05)
    assert number == signal.SIGKILL or not list(tmp_path.iterdir()), "a file is left"


@contextlib.contextmanager
def terminal(*arguments: str) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    process = subprocess.Popen([*COMMAND, *arguments], stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    try:
        yield ours, process
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def until(screen: int, text: str) -> str:
    """Return what the terminal showed until a text came."""
    found, end = "", time.monotonic() + 60
    while text not in found:
        assert time.monotonic() < end, found[-3000:]
        found += os.read(screen, 65536).decode()
    return found


def test_in_a_terminal_keys_freeze_and_end() -> None:
    with terminal("--failures", "0") as (screen, process):
        shown = until(screen, "does the same")
        assert "Press f to freeze the instance that drives, q to end." in shown
        os.write(screen, b"f")
        until(screen, "\x1b[1;31mfrozen")
        until(screen, "none of them reached the robot")
        os.write(screen, b"q")
        assert "survived 1 of 1 freeze" in until(screen, "Next:")
        assert process.wait(20) == 0
