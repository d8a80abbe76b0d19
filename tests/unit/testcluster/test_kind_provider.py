"""The provider `kind` makes, reports and removes clusters. kind and Docker are stand-ins, which record their calls."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from testcluster import cli
from testcluster.paths import REPOSITORY
from testcluster.progress import Progress
from testcluster.providers import kind
from testcluster.providers.base import ClusterError
from testcluster.providers.kind import KindProvider
from testcluster.providers.local import LocalProvider
from tests.support.fake_kind import FakeKind
from tests.unit.testcluster.kind_commands import CONTROL_PLANE, WORKER, WORKERS, cluster_command, kubeconfig

# up


def test_up_creates_a_cluster_with_a_control_plane_and_three_nodes(machine: FakeKind) -> None:
    assert cluster_command("up") == 0
    [created] = machine.calls("kind create cluster")
    folder = kubeconfig().parent
    options = (
        f"--name understudy --config {folder}/configuration.yaml --wait 180s --kubeconfig {folder}/understudy.conf"
    )
    assert created == f"kind create cluster {options}"
    assert list(machine.load()["containers"]) == [CONTROL_PLANE, *WORKERS]


def test_the_configuration_notices_a_lost_node_as_early_as_the_local_provider(machine: FakeKind) -> None:
    cluster_command("up")
    configuration = yaml.safe_load(machine.load()["config"])
    assert (configuration["kind"], configuration["apiVersion"]) == ("Cluster", "kind.x-k8s.io/v1alpha4")
    patches = {patch["kind"]: patch for patch in map(yaml.safe_load, configuration["kubeadmConfigPatches"])}
    assert set(patches) == {"ClusterConfiguration", "KubeletConfiguration"}
    cluster = patches["ClusterConfiguration"]
    assert cluster["controllerManager"]["extraArgs"]["node-monitor-grace-period"] == "6s"
    assert cluster["apiServer"]["extraArgs"]["default-unreachable-toleration-seconds"] == "5"
    assert patches["KubeletConfiguration"]["nodeStatusUpdateFrequency"] == "2s"


def test_the_patches_of_kubeadm_suit_every_version_of_kind(machine: FakeKind) -> None:
    cluster_command("up")
    for patch in map(yaml.safe_load, yaml.safe_load(machine.load()["config"])["kubeadmConfigPatches"]):
        assert "apiVersion" not in patch, (
            "kind applies a patch without a version to v1beta3 and v1beta4, and translates it"
        )
        for part in ("apiServer", "controllerManager"):
            arguments = patch.get(part, {}).get("extraArgs", {})
            assert all(isinstance(value, str) for value in arguments.values()), "kubeadm refuses other types"


def test_up_waits_for_nodes_and_dns_and_names_the_kubeconfig(
    machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster_command("up")
    waits = [call.partition("admin.conf ")[2] for call in machine.calls(f"docker exec {CONTROL_PLANE} kubectl")][-2:]
    assert waits[0].startswith("wait --for=condition=Ready nodes --all")
    assert waits[1].startswith("-n kube-system rollout status deployment/coredns")
    assert f"export KUBECONFIG={kubeconfig()}" in capsys.readouterr().err


def test_up_of_a_running_cluster_changes_nothing(cluster: FakeKind) -> None:
    before = cluster.load()
    assert cluster_command("up") == 0
    assert cluster.load() == before
    assert not cluster.calls("kind create")
    assert not cluster.calls("kind delete")


def test_up_starts_the_nodes_that_are_off(cluster: FakeKind) -> None:
    for node in (CONTROL_PLANE, *WORKERS):
        cluster.change(node, status="exited")
    assert cluster_command("up") == 0
    assert {container["status"] for container in cluster.load()["containers"].values()} == {"running"}


def test_up_ends_every_fault_of_a_node(cluster: FakeKind) -> None:
    for action, node in zip(("freeze", "cut", "stop-runtime"), WORKERS, strict=True):
        assert cluster_command("node", action, node) == 0
    assert cluster_command("up") == 0
    assert cluster_command("status") == 0
    assert not cluster.calls("kind create")


def test_a_cluster_whose_api_server_is_slow_to_start_is_kept(cluster: FakeKind) -> None:
    for node in (CONTROL_PLANE, *WORKERS):
        cluster.change(node, status="exited")
    cluster.load()["refusals"] = 2
    cluster.save()
    assert cluster_command("up") == 0
    assert not cluster.calls("kind delete"), "the cluster was removed with everything in it"


def test_a_cluster_whose_api_server_stays_away_is_kept_and_the_way_out_is_named(
    cluster: FakeKind, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kind, "API_WITHIN", 0.0)
    cluster.load()["refusals"] = 100
    cluster.save()
    assert cluster_command("up") == 1
    message = capsys.readouterr().err
    assert "was refused" in message
    assert "`scripts/cluster down`" in message
    assert not cluster.calls("kind delete")


def test_a_cluster_that_an_interrupted_up_left_unfinished_is_created_again(
    cluster: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    kubeconfig().unlink()
    cluster.load()["joined"] = [CONTROL_PLANE]
    cluster.save()
    assert cluster_command("up") == 0
    assert len(cluster.calls("kind delete cluster")) == len(cluster.calls("kind create cluster")) == 1
    assert "unfinished" in capsys.readouterr().err
    assert cluster_command("status") == 0


def test_a_cluster_that_was_never_initialized_is_created_again(cluster: FakeKind) -> None:
    kubeconfig().unlink()
    cluster.load()["initialized"] = False
    cluster.save()
    assert cluster_command("up") == 0
    assert len(cluster.calls("kind create cluster")) == 1


def test_the_kubeconfig_of_an_earlier_cluster_does_not_make_an_unfinished_one_whole(machine: FakeKind) -> None:
    cluster_command("up")
    machine.load()["containers"].clear()  # removed by hand, with `kind delete cluster`
    machine.save()
    machine.break_command("kind create cluster", "ERROR: failed to create cluster: interrupted")
    assert cluster_command("up") == 1
    assert not kubeconfig().exists()


def test_up_restores_a_kubeconfig_that_was_deleted(cluster: FakeKind) -> None:
    kubeconfig().unlink()
    assert cluster_command("up") == 0
    assert not cluster.calls("kind create")
    assert yaml.safe_load(kubeconfig().read_text())["current-context"] == "kind-understudy"


def test_clusters_of_two_names_exist_side_by_side(cluster: FakeKind) -> None:
    assert cluster_command("up", "--name", "other") == 0
    assert {container["cluster"] for container in cluster.load()["containers"].values()} == {"understudy", "other"}
    assert cluster_command("down", "--name", "other") == 0
    assert list(cluster.load()["containers"]) == [CONTROL_PLANE, *WORKERS]


# status, kubeconfig, down


def test_status_lists_the_nodes_and_the_kubeconfig(cluster: FakeKind, capsys: pytest.CaptureFixture[str]) -> None:
    assert cluster_command("status") == 0
    summary, *details = capsys.readouterr().out.splitlines()
    assert summary == "cluster understudy (kind) is ready"
    assert [line.split()[0] for line in details[:4]] == [CONTROL_PLANE, *WORKERS]
    assert details[4].split() == ["kubeconfig:", str(kubeconfig())]


def test_a_cluster_with_a_node_that_is_off_is_not_ready(cluster: FakeKind, capsys: pytest.CaptureFixture[str]) -> None:
    cluster_command("node", "down", WORKER)
    assert cluster_command("status") == 1
    assert "is not ready" in capsys.readouterr().out


def test_a_cordoned_node_is_ready(cluster: FakeKind) -> None:
    cluster.load()["cordoned"] = [WORKER]
    cluster.save()
    assert cluster_command("status") == 0


def test_the_status_of_a_cluster_without_an_api_server_has_the_reason(
    cluster: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.change(CONTROL_PLANE, status="exited")
    assert cluster_command("status") == 1
    out = capsys.readouterr().out
    assert "its API server does not answer" in out
    assert "is not running" in out


def test_without_a_cluster_status_and_kubeconfig_report_that(
    machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command("status") == 1
    assert capsys.readouterr().out == "cluster understudy: there is none\n"
    assert cluster_command("kubeconfig") == 1
    assert "`scripts/cluster up --provider kind` makes it" in capsys.readouterr().err


def test_the_kubeconfig_is_printed_and_nothing_else(cluster: FakeKind, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert cluster_command("kubeconfig") == 0
    assert capsys.readouterr().out == f"{kubeconfig()}\n"
    assert kubeconfig().is_file()


def test_down_removes_the_cluster_and_its_kubeconfig_and_may_be_repeated(cluster: FakeKind) -> None:
    for _ in range(2):
        assert cluster_command("down") == 0
        assert not cluster.load()["containers"]
        assert not kubeconfig().exists()
    assert cluster.calls("kind delete")[0] == f"kind delete cluster --name understudy --kubeconfig {kubeconfig()}"


# images


def test_an_image_of_docker_and_an_archive_are_loaded_in_their_own_ways(cluster: FakeKind, tmp_path: Path) -> None:
    cluster.load()["images"]["localhost/thing:dev"] = "sha256:1"
    cluster.save()
    archive = tmp_path / "thing.tar"
    archive.touch()
    assert cluster_command("load-image", "localhost/thing:dev", str(archive)) == 0
    assert cluster.calls("kind load") == [
        "kind load docker-image --name understudy localhost/thing:dev",
        f"kind load image-archive --name understudy {archive}",
    ]


def test_an_image_that_docker_does_not_have_is_refused(cluster: FakeKind, capsys: pytest.CaptureFixture[str]) -> None:
    assert cluster_command("load-image", "localhost/thing:dev") == 1
    message = capsys.readouterr().err
    assert "localhost/thing:dev" in message
    assert "scripts/images builds the project's own" in message
    assert not cluster.calls("kind load")


# selection, and the command


def test_where_docker_and_kind_work_kind_is_chosen(machine: FakeKind, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LocalProvider, "obstacle", staticmethod(lambda: None))
    assert isinstance(cli.select(None, None, Progress()), KindProvider)
    machine.stop_docker()
    assert isinstance(cli.select(None, None, Progress()), LocalProvider)


def test_if_no_provider_can_be_used_the_message_says_what_each_lacks(
    machine: FakeKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LocalProvider, "obstacle", staticmethod(lambda: "this is not root"))
    machine.remove("kind")
    with pytest.raises(
        ClusterError, match=r"kind: the program `kind` is missing; local: this is not root.*--provider current"
    ):
        cli.select(None, None, Progress())


def test_the_script_takes_the_provider_and_the_name_from_the_environment(
    machine: FakeKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_PROVIDER", "kind")
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_NAME", "mine")
    for command, code, said in (("up", 0, ""), ("status", 0, "cluster mine (kind) is ready"), ("down", 0, "")):
        script = [sys.executable, str(REPOSITORY / "scripts" / "cluster"), command]
        done = subprocess.run(script, capture_output=True, text=True)
        assert (done.returncode, done.stdout.partition("\n")[0]) == (code, said), done.stderr
    assert machine.calls("kind delete cluster")[0].startswith("kind delete cluster --name mine ")
