"""What the provider `kind` reports if a program is missing or fails: the reason and the way out."""

from __future__ import annotations

import pytest

from tests.support.fake_kind import FakeKind
from tests.unit.testcluster.kind_commands import CONTROL_PLANE, WORKER, cluster_command, kubeconfig

EVERY_COMMAND = [
    ("up",),
    ("down",),
    ("status",),
    ("load-image", "localhost/thing:dev"),
    ("node", "down", WORKER),
    ("node", "up", WORKER),
]


@pytest.mark.parametrize("arguments", EVERY_COMMAND)
@pytest.mark.parametrize("program", ["kind", "docker"])
def test_a_missing_program_is_named_together_with_the_way_out(
    machine: FakeKind, program: str, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    machine.remove(program)
    assert cluster_command(*arguments) == 1
    message = capsys.readouterr().err
    assert f"the program `{program}` is missing" in message
    assert "--provider local" in message


@pytest.mark.parametrize("arguments", EVERY_COMMAND)
def test_if_docker_does_not_run_its_own_reason_is_reported(
    machine: FakeKind, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    machine.stop_docker()
    assert cluster_command(*arguments) == 1
    message = capsys.readouterr().err
    assert "Docker does not answer" in message
    assert "Is the docker daemon running?" in message
    assert "--provider local" in message
    assert not machine.calls("kind")


def test_a_failing_creation_has_kinds_reason_and_the_ways_out(
    machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    machine.break_command("kind create cluster", "ERROR: failed to create cluster: could not find a line that matches")
    assert cluster_command("up") == 1
    message = capsys.readouterr().err
    assert "could not find a line that matches" in message
    assert "--retain" in message
    assert "--provider local" in message
    assert not kubeconfig().exists()


def test_a_node_that_does_not_become_ready_fails_the_start(
    cluster: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.break_command(
        f"docker exec {CONTROL_PLANE} kubectl --kubeconfig=/etc/kubernetes/admin.conf wait", "error: timed out"
    )
    assert cluster_command("up") == 1
    assert "timed out" in capsys.readouterr().err
    assert not cluster.calls("kind delete")
