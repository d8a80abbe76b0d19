"""Faults of nodes that the provider `kind` causes and ends, by commands of Docker."""

from __future__ import annotations

import pytest

from tests.support.fake_kind import FakeKind
from tests.unit.testcluster.kind_commands import CONTROL_PLANE, WORKER, WORKERS, cluster_command


@pytest.mark.parametrize(
    ("actions", "command"),
    [
        (["down"], f"docker kill {WORKER}"),
        (["down", "up"], f"docker start {WORKER}"),
        (["freeze"], f"docker pause {WORKER}"),
        (["freeze", "thaw"], f"docker unpause {WORKER}"),
        (["freeze", "up"], f"docker unpause {WORKER}"),
        (["cut"], f"docker network disconnect kind {WORKER}"),
        (["cut", "connect"], f"docker network connect kind {WORKER}"),
        (["cut", "up"], f"docker network connect kind {WORKER}"),
        (["stop-runtime"], f"docker exec {WORKER} systemctl stop containerd kubelet"),
        (["stop-runtime", "start-runtime"], f"docker exec {WORKER} systemctl start containerd kubelet"),
        (["stop-runtime", "up"], f"docker exec {WORKER} systemctl start containerd kubelet"),
    ],
)
def test_a_fault_and_its_end_are_commands_of_docker(cluster: FakeKind, actions: list[str], command: str) -> None:
    for action in actions:
        assert cluster_command("node", action, WORKER) == 0
    assert command in cluster.calls("docker")
    assert cluster_command("status") == (1 if len(actions) == 1 else 0)


@pytest.mark.parametrize("action", ["down", "up", "freeze", "thaw", "cut", "connect", "stop-runtime", "start-runtime"])
def test_every_operation_on_a_node_may_be_repeated(cluster: FakeKind, action: str) -> None:
    assert cluster_command("node", action, WORKER) == 0
    once = cluster.load()
    assert cluster_command("node", action, WORKER) == 0
    assert cluster.load() == once


def test_a_node_that_was_cut_off_and_lost_its_power_has_its_network_before_it_starts(cluster: FakeKind) -> None:
    for action in ("cut", "down", "up"):
        assert cluster_command("node", action, WORKER) == 0
    assert cluster.container(WORKER)["status"] == "running", "without an address a node of kind ends during its start"
    assert cluster_command("status") == 0


def test_a_frozen_node_can_lose_its_power(cluster: FakeKind) -> None:
    for action in ("freeze", "down"):
        assert cluster_command("node", action, WORKER) == 0
    assert cluster.container(WORKER)["status"] == "exited"


@pytest.mark.parametrize("action", ["freeze", "stop-runtime"])
def test_a_fault_that_needs_a_running_node_says_how_it_is_switched_on(
    cluster: FakeKind, action: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster_command("node", "down", WORKER)
    assert cluster_command("node", action, WORKER) == 1
    assert f"scripts/cluster node up {WORKER}" in capsys.readouterr().err


@pytest.mark.parametrize("node", ["node2", CONTROL_PLANE])
def test_for_another_node_those_that_can_have_faults_are_named(
    cluster: FakeKind, node: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command("node", "down", node) == 1
    assert ", ".join(WORKERS) in capsys.readouterr().err
    assert not cluster.calls("docker kill")


@pytest.mark.parametrize("arguments", [("node", "down", WORKER), ("load-image", "localhost/thing:dev")])
def test_without_a_cluster_operations_on_it_name_the_command_that_makes_it(
    machine: FakeKind, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command(*arguments) == 1
    assert "`scripts/cluster up --provider kind` makes it" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [("api", "stop"), ("api", "start"), ("network", WORKER, "--deaf")])
def test_what_only_the_local_provider_can_do_is_refused_with_its_name(
    cluster: FakeKind, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command(*arguments) == 1
    message = capsys.readouterr().err
    assert "provider kind" in message
    assert "provider local" in message
    assert not cluster.calls()
