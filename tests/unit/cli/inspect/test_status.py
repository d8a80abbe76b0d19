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
from typing import Any

import pytest
import yaml

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.cli.common.text.terminal import BEGIN, COLOR, END
from understudy.cli.inspect.status import REFRESH, main

REPOSITORY = Path(__file__).parents[4]
LONG = 60.0
"""Seconds that are waited for anything."""

GATES = "networkpolicies.networking.k8s.io,leases.coordination.k8s.io"


def test_the_status_shows_the_fleet_on_one_screen(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    assert main(["-n", "fleet", "--context", "lab"]) == 1, "one of them isn't protected"
    output = capsys.readouterr().out
    assert output.startswith("ROBOT ")
    assert output.endswith("3 robots: 1 not protected; 1 degraded, 2 healthy\n")
    assert "\x1b" not in output, "colours are for terminals"
    gates, asked = stand.asked
    assert asked.startswith(
        "--namespace=fleet --context=lab get robotworkloads.understudy.dev,fallbackpools.understudy.dev -o json"
    )
    ours = "-l app.kubernetes.io/managed-by=understudy"
    assert gates.startswith(f"--namespace=fleet --context=lab get {GATES} {ours} -o json"), (
        "and before the robots: what their status tells of isn't under way"
    )


def test_robots_can_be_selected_by_labels(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-l", "app=navigation", "-o", "name"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        f"robotworkload.understudy.dev/robot-{number}-navigation" for number in (17, 18, 19)
    ]
    assert "get robotworkloads.understudy.dev -l app=navigation -o json" in stand.asked[-1]
    assert main(["-l", "app=other"]) == 2
    assert "there is no RobotWorkload with labels app=other in this namespace" in capsys.readouterr().err


def test_names_and_labels_exclude_each_other(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-17-navigation", "-l", "app=navigation"]) == 2
    assert "give either names or -l/--selector" in capsys.readouterr().err


def test_user_and_timeout_are_passed_to_kubectl(stand: FakeKubectl) -> None:
    assert main(["--as", "ann", "--request-timeout", "1m"]) == 1
    assert all(line.startswith("--as=ann get ") and line.endswith("--request-timeout=60s") for line in stand.asked)


def test_robots_can_be_selected_by_name(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-17-navigation"]) == 0
    assert capsys.readouterr().out.endswith("1 robot: all protected; 1 healthy\n")
    assert main(["robot-17-navigation", "robot-18-navigation"]) == 0
    assert capsys.readouterr().out.endswith("2 robots: all protected; 1 degraded, 1 healthy\n")
    assert "POOL" not in capsys.readouterr().out


def test_the_status_can_cover_every_namespace(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    main(["-A"])
    assert capsys.readouterr().out.startswith("NAMESPACE  ROBOT ")
    assert all(" -A -o json" in asked for asked in stand.asked)


@pytest.mark.parametrize(("output", "read"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_json_output_contains_everything(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], output: str, read: type
) -> None:
    assert main(["-o", output]) == 1
    printed_text = read(capsys.readouterr().out)
    first, _, third = printed_text["robots"]
    assert first["active"] == "robot-17-navigation-x8v2m"
    assert first["lastRecovery"]["recoverySeconds"] == pytest.approx(0.509)
    assert (third["protected"], third["problems"][0]["reason"]) == (False, "ImagePullBackOff")
    assert [pool["ready"] for pool in printed_text["pools"]] == [2, 3]


def recovering(**changes: Any) -> list[dict[str, Any]]:
    """The fleet, and a gate that records a recovery."""
    return [*fleet.fleet(), fleet.gate(fleet.well(), fleet.under_way(**changes))]


def test_a_recovery_is_shown_from_the_gate_before_the_status_reports_it(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    stand.tell(recovering())
    assert main([]) == 1
    output = capsys.readouterr().out
    assert_golden(
        "status",
        output,
        "3 robots",
        "1 not protected",
        "1 degraded",
        "1 healthy",
        "1 recovering",
        "recovering (FailureDetected, 1s)",
        "Fallback/Executing",
        "/cmd_vel",
        "500 ms",
    )
    assert main(["-o", "json"]) == 1
    first, second, _ = json.loads(capsys.readouterr().out)["robots"]
    assert (first["health"], first["active"], first["epoch"]) == ("Recovering", "robot-17-navigation-w7h5k", 42)
    assert first["recovering"] == {
        "reason": "no /cmd_vel for 500 ms",
        "occasion": "FailureDetected",
        "since": fleet.ago(1),
        "strategy": "Fallback/Executing",
        "pod": "robot-17-navigation-w7h5k",
        "tried": [],
    }
    assert "recovering" not in second


@pytest.mark.parametrize(
    ("others", "expected"), [([], "Recovering"), (["robot-18-navigation"], "Recovering"), (["robot-2"], "not found")]
)
def test_gates_of_selected_robots_are_requested_by_name(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None, others: list[str], expected: str
) -> None:
    stand.tell(recovering())
    main(["robot-17-navigation", *others])
    captured = capsys.readouterr()
    assert expected in captured.out + captured.err, "whether or not the others have a gate"
    gates = " ".join(f"{name}-gate" for name in ["robot-17-navigation", *others])
    assert stand.asked[0].startswith(f"get {GATES} {gates} --ignore-not-found -o json")


def test_without_the_right_to_read_gates_the_status_is_shown(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    stand.tell(recovering(), forbidden=["networkpolicies"])
    assert main([]) == 1
    captured = capsys.readouterr()
    assert captured.out.endswith("3 robots: 1 not protected; 1 degraded, 2 healthy\n")
    assert captured.err == ""
    stand.tell(fleet.fleet(), forbidden=["robotworkloads"])
    assert main([]) == 2, "without robots there is nothing to be shown"
    assert_golden("status", capsys.readouterr().err, "robotworkloads.understudy.dev", "fallbackpools.understudy.dev")


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["robot-2"], "", 'robotworkloads.understudy.dev "robot-2" not found'),
        ([], "error: the server doesn't have a resource type", "the server doesn't have a resource type"),
        (["-w"], "Unable to connect to the server", "Unable to connect to the server"),
    ],
)
def test_unavailable_information_is_reported(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], arguments: list[str], error: str, words: str
) -> None:
    stand.tell(fleet.fleet(), error=error)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("understudy status: ")
    assert words in captured.err


def test_an_empty_fleet_is_not_reported_as_protected(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell([fleet.spare()])
    assert main([]) == 2
    assert "there is no RobotWorkload in this namespace" in capsys.readouterr().err


def test_watch_with_machine_readable_output_is_refused(stand: FakeKubectl) -> None:
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
        self.output = ""

    def until(self, words: str) -> str:
        """What it wrote from here to these words."""
        end, begin = time.monotonic() + LONG, len(self.output)
        while words not in self.output[begin:]:
            left = end - time.monotonic()
            assert left > 0, f"{words!r} was not told within {LONG} s, but {self.output[begin:]!r}"
            if select.select([self._reading], [], [], left)[0]:
                chunk = os.read(self._reading, 65536).decode()
                assert chunk, f"it ended with {self.process.wait(LONG)} before {words!r}"
                self.output += chunk
        return self.output[begin:]

    def end(self) -> int:
        """End it as Ctrl-C does; its exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(LONG)

    def close(self) -> None:
        if self.process.poll() is None:
            self.end()  # killed outright, it would leave behind the kubectl that watches for it
        os.close(self._reading)


def line_of(health: str, written: str) -> str:
    """The line of the robot in this state, without the time of day."""
    (line,) = (line for line in written.splitlines() if f"; {health}; " in line)
    return line.partition(" ")[2]


@pytest.fixture
def watching(request: pytest.FixtureRequest, stand: FakeKubectl) -> Iterator[Watching]:
    made = Watching(**request.param)
    yield made
    made.close()


def test_changes_are_shown_without_the_right_to_watch(stand: FakeKubectl) -> None:
    stand.tell(fleet.fleet(), watch=False)
    watching = Watching(terminal=False)
    try:
        watching.until("fleet/robot-19-navigation; Healthy")
        stand.tell([fleet.degraded(), fleet.unprotected()], watch=False)
        watching.until("fleet/robot-17-navigation; deleted")
    finally:
        watching.close()


def test_an_unavailable_api_server_is_asked_again(stand: FakeKubectl) -> None:
    watching = Watching(terminal=False)
    try:
        watching.until("fleet/robot-19-navigation; Healthy")
        stand.tell([], error="Unable to connect to the server")
        watching.until("Unable to connect to the server; retrying")
        stand.tell([fleet.degraded()])
        watching.until("fleet/robot-17-navigation; deleted")
        assert watching.end() == 0
    finally:
        watching.close()


@pytest.mark.parametrize("watching", [{"terminal": True}], indirect=True)
def test_the_screen_is_redrawn_when_a_robot_changes(stand: FakeKubectl, watching: Watching) -> None:
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


@pytest.mark.parametrize("watching", [{"terminal": False}], indirect=True)
def test_a_change_of_the_gate_is_shown_at_once_until_the_status_reports_the_end(
    stand: FakeKubectl, watching: Watching
) -> None:
    watching.until("fleet/robot-19-navigation; Healthy")
    began = time.time()
    beside = fleet.gate(fleet.well(), fleet.under_way(began=began))
    stand.tell([*fleet.fleet(), beside])
    assert_golden(
        "status",
        line_of("Recovering", watching.until("Fallback/Executing is tried with robot-17-navigation-w7h5k.")),
        "fleet/robot-17-navigation; Recovering; protected",
        "robot-17-navigation-w7h5k (epoch 42)",
    )
    assert time.time() - began < REFRESH, "it was told of it, and didn't find it by asking again"
    recovered = fleet.well()
    recovered["status"]["recoveries"].insert(0, fleet.recovery(4, fleet.NOW - began).to_wire())
    stand.tell([recovered, *fleet.fleet()[1:], beside])
    assert "robot-18" not in watching.until("fleet/robot-17-navigation; Healthy")
    assert watching.end() == 1


def test_robots_can_be_watched_without_the_right_to_read_gates(stand: FakeKubectl) -> None:
    stand.tell(recovering(began=time.time()), forbidden=["networkpolicies"])
    began = time.monotonic()
    watching = Watching(terminal=False)
    try:
        watching.until("fleet/robot-19-navigation; Healthy")
        stand.tell([*recovering(began=time.time())[1:]], forbidden=["networkpolicies"])
        watching.until("fleet/robot-17-navigation; deleted")
        assert "Recovering" not in watching.output
        requests = [line for line in stand.asked if f"get {GATES}" in line and "-o json" in line]
        assert len(requests) <= 1 + (time.monotonic() - began) // REFRESH, "once is enough for a while"
    finally:
        watching.close()


@pytest.mark.parametrize("watching", [{"terminal": True, "environment": {"NO_COLOR": "1"}}], indirect=True)
def test_colours_can_be_disabled(watching: Watching) -> None:
    assert "\x1b[36m" not in watching.until("3 robots: 1 not protected")


@pytest.mark.parametrize("watching", [{"terminal": True, "environment": {"TERM": "dumb"}}], indirect=True)
def test_a_terminal_without_control_sequences_gets_lines(watching: Watching) -> None:
    assert "\x1b" not in watching.until("fleet/robot-19-navigation; Healthy; NOT PROTECTED")


def test_colours_can_be_had_without_a_terminal(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(COLOR, "always")
    assert main([]) == 1
    assert "\x1b[36m" in capsys.readouterr().out


@pytest.mark.parametrize("watching", [{"terminal": False}], indirect=True)
def test_without_a_terminal_each_change_is_one_line(stand: FakeKubectl, watching: Watching) -> None:
    watching.until("fleet/robot-19-navigation; Healthy; NOT PROTECTED")
    failed = fleet.well()
    failed["status"] |= {"health": "Failed"}
    stand.tell([failed, fleet.degraded()])
    changed = watching.until("fleet/robot-19-navigation; deleted")
    assert_golden(
        "status",
        line_of("Failed", changed),
        "fleet/robot-17-navigation; Failed; protected",
        "robot-17-navigation-x8v2m (epoch 41)",
    )
    assert "robot-18" not in changed, "it is as it was"
    stand.tell([fleet.well(), fleet.degraded()])
    watching.until("fleet/robot-17-navigation; Healthy")
    assert "\x1b" not in watching.output
    assert watching.end() == 0
