"""``understudy status``: what it asks kubectl, what it tells in a terminal and elsewhere, and how it ends."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.unit.console import fleet
from tests.unit.console.kubectl import Stand
from understudy.console.status import main
from understudy.console.terminal import BEGIN, END

REPOSITORY = Path(__file__).parents[3]
LONG = 60.0
"""Seconds that are waited for anything."""


def test_the_fleet_on_one_screen(stand: Stand, capsys: pytest.CaptureFixture[str], in_the_present: None) -> None:
    assert main(["-n", "fleet", "--context", "lab"]) == 1, "one of them isn't protected"
    told = capsys.readouterr().out
    assert told.startswith("ROBOT ")
    assert told.endswith("3 robots: 1 not protected; 1 degraded, 2 healthy\n")
    assert "\x1b" not in told, "colours are for terminals"
    (asked,) = stand.asked
    assert asked.startswith(
        "--namespace=fleet --context=lab get robotworkloads.understudy.dev,fallbackpools.understudy.dev -o json"
    )


def test_some_of_them_by_name(stand: Stand, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-17-navigation"]) == 0
    assert capsys.readouterr().out.endswith("1 robot: all protected; 1 healthy\n")
    assert main(["robot-17-navigation", "robot-18-navigation"]) == 0
    assert capsys.readouterr().out.endswith("2 robots: all protected; 1 degraded, 1 healthy\n")
    assert "POOL" not in capsys.readouterr().out


def test_every_namespace(stand: Stand, capsys: pytest.CaptureFixture[str]) -> None:
    main(["-A"])
    assert capsys.readouterr().out.startswith("NAMESPACE  ROBOT ")
    assert " -A -o json" in stand.asked[0]


@pytest.mark.parametrize(("output", "read"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_everything_for_scripts(stand: Stand, capsys: pytest.CaptureFixture[str], output: str, read: type) -> None:
    assert main(["-o", output]) == 1
    told = read(capsys.readouterr().out)
    first, _, third = told["robots"]
    assert first["active"] == "robot-17-navigation-x8v2m"
    assert first["lastRecovery"]["recoverySeconds"] == pytest.approx(0.509)
    assert (third["protected"], third["problems"][0]["reason"]) == (False, "ImagePullBackOff")
    assert [pool["ready"] for pool in told["pools"]] == [2, 3]


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["robot-2"], "", 'robotworkloads.understudy.dev "robot-2" not found'),
        ([], "error: the server doesn't have a resource type", "the server doesn't have a resource type"),
        (["-w"], "Unable to connect to the server", "Unable to connect to the server"),
    ],
)
def test_what_can_not_be_told(
    stand: Stand, capsys: pytest.CaptureFixture[str], arguments: list[str], error: str, words: str
) -> None:
    stand.tell(fleet.fleet(), error=error)
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("understudy status: ")
    assert words in told.err


def test_no_robot_at_all_is_not_all_protected(stand: Stand, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell([fleet.spare()])
    assert main([]) == 2
    assert "there is no RobotWorkload in this namespace" in capsys.readouterr().err


def test_watching_is_not_for_scripts(stand: Stand) -> None:
    with pytest.raises(SystemExit):
        main(["-w", "-o", "json"])


class Watching:
    """``understudy status -w`` in a process of its own."""

    def __init__(self, *, terminal: bool, environment: dict[str, str] | None = None) -> None:
        if terminal:
            self._reading, writing = pty.openpty()
            fcntl.ioctl(writing, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
        else:
            self._reading, writing = os.pipe()
        variables = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")}
        variables |= {"PYTHONPATH": str(REPOSITORY / "operator")} | (environment or {})
        command = [sys.executable, "-m", "understudy", "status", "-w"]
        self.process = subprocess.Popen(command, stdout=writing, env=variables)
        os.close(writing)
        self.told = ""

    def until(self, words: str) -> str:
        """What it wrote from here to these words."""
        end, begin = time.monotonic() + LONG, len(self.told)
        while words not in self.told[begin:]:
            left = end - time.monotonic()
            assert left > 0, f"{words!r} was not told within {LONG} s, but {self.told[begin:]!r}"
            if select.select([self._reading], [], [], left)[0]:
                self.told += os.read(self._reading, 65536).decode()
        return self.told[begin:]

    def end(self) -> int:
        """End it as Ctrl-C does; its exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(LONG)

    def close(self) -> None:
        if self.process.poll() is None:
            self.end()  # killed outright, it would leave behind the kubectl that watches for it
        os.close(self._reading)


@pytest.fixture
def watching(request: pytest.FixtureRequest, stand: Stand) -> Iterator[Watching]:
    made = Watching(**request.param)
    yield made
    made.close()


def test_who_may_not_watch_sees_changes_all_the_same(stand: Stand) -> None:
    stand.tell(fleet.fleet(), watch=False)
    watching = Watching(terminal=False)
    try:
        watching.until("fleet/robot-19-navigation; Healthy")
        stand.tell([fleet.degraded(), fleet.unprotected()], watch=False)
        watching.until("fleet/robot-17-navigation; is gone")
    finally:
        watching.close()


def test_an_api_server_that_does_not_answer_is_asked_again(stand: Stand) -> None:
    watching = Watching(terminal=False)
    try:
        watching.until("fleet/robot-19-navigation; Healthy")
        stand.tell([], error="Unable to connect to the server")
        watching.until("Unable to connect to the server; asking again")
        stand.tell([fleet.degraded()])
        watching.until("fleet/robot-17-navigation; is gone")
        assert watching.end() == 0
    finally:
        watching.close()


@pytest.mark.parametrize("watching", [{"terminal": True}], indirect=True)
def test_a_terminal_s_screen_is_written_anew_when_a_robot_changes(stand: Stand, watching: Watching) -> None:
    first = watching.until("3 robots: 1 not protected")
    assert first.startswith(BEGIN)
    assert "\x1b[2J" not in first, "a screen that is cleared flickers"
    assert "\x1b[1;31mFailed" not in first
    failed = fleet.well()
    failed["status"] |= {"health": "Failed"}
    stand.tell([failed, fleet.degraded(), fleet.unprotected()])
    assert "\x1b[H" in watching.until("\x1b[1;31mFailed")
    status = watching.end()
    watching.until(END)
    assert status == 1


@pytest.mark.parametrize("watching", [{"terminal": True, "environment": {"NO_COLOR": "1"}}], indirect=True)
def test_no_colours_where_none_are_wanted(watching: Watching) -> None:
    assert "\x1b[32m" not in watching.until("3 robots: 1 not protected")


@pytest.mark.parametrize("watching", [{"terminal": False}], indirect=True)
def test_elsewhere_each_change_is_a_line(stand: Stand, watching: Watching) -> None:
    watching.until("fleet/robot-19-navigation; Healthy; NOT PROTECTED")
    failed = fleet.well()
    failed["status"] |= {"health": "Failed"}
    stand.tell([failed, fleet.degraded()])
    changed = watching.until("fleet/robot-19-navigation; is gone")
    assert "fleet/robot-17-navigation; Failed; protected; in control robot-17-navigation-x8v2m (epoch 41)" in changed
    assert "robot-18" not in changed, "it is as it was"
    stand.tell([fleet.well(), fleet.degraded()])
    watching.until("fleet/robot-17-navigation; Healthy")
    assert "\x1b" not in watching.told
    assert watching.end() == 0
