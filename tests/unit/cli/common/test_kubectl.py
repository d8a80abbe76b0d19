"""What is said where kubectl can't do what it is asked for."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.errors import CommandError
from understudy.cli.inspect import timeline

NAME = "robot-17-navigation"

ASKS = """
if not sys.stdin.isatty():
    sys.exit("Unable to connect to the server: getting credentials: exec plugin cannot support interactive mode: standard input is "
        "not a terminal")
print("Token: ", end="", file=sys.stderr, flush=True)
if sys.stdin.readline() != "good\\n":
    sys.exit("Unable to connect to the server: getting credentials: exec: executable login failed with exit code 1")
"""
"""What kubectl does by a plugin that asks."""

WAITS = """
print("E1123 14:32:20.950992 8158 memcache.go:265] nothing for people", file=sys.stderr, flush=True)
print("To sign in, enter the code ABC", file=sys.stderr, flush=True)
while not os.path.exists(path + ".entered"):
    time.sleep(0.05)
"""
"""And by one that waits for somebody to enter a code elsewhere."""


@pytest.mark.parametrize(
    ("stderr", "message"),
    [
        (
            "The connection to the server localhost:8080 was refused - did you specify the right host or port?",
            "kubectl found no kubeconfig and tried the default address; set --kubeconfig or KUBECONFIG",
        ),
        (
            "The connection to the server 10.0.0.1:6443 was refused - did you specify the right host or port?",
            "check that the API server runs, or choose another cluster with --context or --kubeconfig",
        ),
        (
            "error: current-context must exist in order to minify",
            "the kubeconfig has no current context; set --context",
        ),
        ("Error in configuration: context was not found for specified context: lab", "kubectl config get-contexts"),
        ('error: context "lab" does not exist', "kubectl config get-contexts"),
        ('error: the server doesn\'t have a resource type "robotworkloads"', "install the chart"),
        ("error: You must be logged in to the server (Unauthorized)", "log in again"),
    ],
)
def test_an_error_of_kubectl_is_reported_with_a_cure(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], stderr: str, message: str
) -> None:
    stand.tell(fleet.fleet(), error=stderr)
    assert timeline.main([NAME]) == 2
    error = capsys.readouterr().err
    plain = stderr.removeprefix("error: ").removeprefix("Error in configuration: ").partition(" - did")[0]
    assert error.startswith(f"understudy timeline: {plain}: ")
    assert message in error


def test_a_kubeconfig_without_credentials_is_reported(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell(fleet.fleet(), error="error: EOF")
    assert timeline.main([NAME]) == 2
    assert_golden("command_line", capsys.readouterr().err, "understudy timeline: ", "no credentials")


def test_an_unknown_error_of_kubectl_is_reported_unchanged(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell(fleet.fleet(), error="Unable to connect to the server: net/http: TLS handshake timeout")
    assert timeline.main([NAME]) == 2
    assert_golden("command_line", capsys.readouterr().err, "understudy timeline: ", "TLS handshake timeout")


def test_kubectl_gets_an_empty_standard_input(stand: FakeKubectl) -> None:
    """Or it would wait for a name or a password that nobody knows it asks for, since what it writes is read by the command."""
    stand.begin_with("assert not sys.stdin.read()")
    assert timeline.main([NAME]) == 0


def started(stdin: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "understudy", "timeline", NAME]
    return subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def read_until(running: subprocess.Popen[bytes], words: bytes) -> bytes:
    """What it says, up to these words; all of it where they don't come."""
    assert running.stderr is not None
    found = b""
    while words not in found and (more := os.read(running.stderr.fileno(), 4096)):
        found += more
    return found


def test_the_user_at_the_terminal_can_answer_a_credential_plugin(stand: FakeKubectl) -> None:
    stand.begin_with(ASKS)
    ours, its = os.openpty()
    with started(its) as running:
        assert read_until(running, b"Token: ") == b"Token: "
        os.write(ours, b"good\n")
        output, errors = running.communicate(timeout=60)
    assert (running.returncode, errors) == (0, b"")
    assert output.decode().startswith(f"fleet/{NAME}: 3 recoveries\n")


def test_an_answer_that_the_plugin_rejects_is_reported(stand: FakeKubectl) -> None:
    stand.begin_with(ASKS)
    ours, its = os.openpty()
    with started(its) as running:
        read_until(running, b"Token: ")
        os.write(ours, b"bad\n")
        _, errors = running.communicate(timeout=60)
    assert running.returncode == 2
    assert_golden("command_line", errors.decode(), "login failed with exit code 1")


def test_instructions_of_a_waiting_plugin_are_shown(stand: FakeKubectl) -> None:
    stand.begin_with(WAITS)
    with started(subprocess.DEVNULL) as running:
        assert read_until(running, b"ABC\n") == b"To sign in, enter the code ABC\n"
        Path(stand.folder, "settings.json.entered").touch()
        output, _ = running.communicate(timeout=60)
    assert (running.returncode, output[:5]) == (0, b"fleet")


@pytest.mark.parametrize("place", ["a script", "a shell that completes"])
def test_a_plugin_does_not_ask_without_a_terminal(
    stand: FakeKubectl, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    stand.begin_with(ASKS)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: place != "a script", raising=False)
    if place != "a script":
        monkeypatch.setenv("_ARGCOMPLETE", "2")
    arguments = argparse.Namespace(namespace="fleet", context=None, kubeconfig=None)
    started_at = time.monotonic()
    with pytest.raises(CommandError, match="not a terminal: log in with the kubeconfig's credential plugin"):
        Kubectl(arguments).get("robotworkloads.understudy.dev", NAME)
    assert time.monotonic() - started_at < 10


def test_a_plugin_does_not_ask_without_standard_input(stand: FakeKubectl, monkeypatch: pytest.MonkeyPatch) -> None:
    stand.begin_with(ASKS)
    monkeypatch.setattr(sys, "stdin", None)  # as Python has it after `<&-`
    with pytest.raises(CommandError, match="not a terminal: log in with the kubeconfig's credential plugin"):
        Kubectl(argparse.Namespace(namespace="fleet", context=None, kubeconfig=None)).get("pods")
