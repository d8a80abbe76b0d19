"""What is said where kubectl can't do what it is asked for."""

from __future__ import annotations

import pytest

from tests.unit.console import fleet
from tests.unit.console.kubectl import Stand
from understudy.console import timeline

NAME = "robot-17-navigation"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            "The connection to the server localhost:8080 was refused - did you specify the right host or port?",
            "no kubeconfig was found, so kubectl asked there; name yours by --kubeconfig or KUBECONFIG",
        ),
        (
            "The connection to the server 10.0.0.1:6443 was refused - did you specify the right host or port?",
            "look whether its API server runs, or name another cluster by --context or --kubeconfig",
        ),
        (
            "error: current-context must exist in order to minify",
            "the kubeconfig says no context; name one by --context",
        ),
        ("Error in configuration: context was not found for specified context: lab", "kubectl config get-contexts"),
        ('error: context "lab" does not exist', "kubectl config get-contexts"),
        ('error: the server doesn\'t have a resource type "robotworkloads"', "install the chart"),
        ("error: You must be logged in to the server (Unauthorized)", "log in anew"),
    ],
)
def test_what_kubectl_says_is_told_with_the_way_out(
    stand: Stand, capsys: pytest.CaptureFixture[str], said: str, told: str
) -> None:
    stand.tell(fleet.fleet(), error=said)
    assert timeline.main([NAME]) == 2
    error = capsys.readouterr().err
    plain = said.removeprefix("error: ").removeprefix("Error in configuration: ").partition(" - did")[0]
    assert error.startswith(f"understudy timeline: {plain}: ")
    assert told in error


def test_a_kubeconfig_without_credentials_is_told_as_that(stand: Stand, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell(fleet.fleet(), error="error: EOF")
    assert timeline.main([NAME]) == 2
    assert capsys.readouterr().err.startswith("understudy timeline: the kubeconfig has no credentials for this cluster")


def test_what_it_says_itself_is_left_as_it_is(stand: Stand, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell(fleet.fleet(), error="Unable to connect to the server: net/http: TLS handshake timeout")
    assert timeline.main([NAME]) == 2
    assert capsys.readouterr().err == (
        "understudy timeline: Unable to connect to the server: net/http: TLS handshake timeout\n"
    )


def test_kubectl_is_left_nothing_to_read(stand: Stand) -> None:
    """Or it would wait for a name or a password that nobody knows it asks for, since what it writes is read by the command."""
    program = stand.folder / "kubectl"
    program.write_text(
        program.read_text().replace("given = sys.argv[1:]", "given = sys.argv[1:]\nassert not sys.stdin.read()", 1)
    )
    assert timeline.main([NAME]) == 0
