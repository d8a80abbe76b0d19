"""The provider `current` uses the cluster of a kubeconfig, and never makes, changes or removes one."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from testcluster import cli
from testcluster.progress import Progress
from testcluster.providers.current import CurrentProvider
from tests.support.fake_kind import FakeKind
from tests.support.fake_kubectl import FakeKubectl

PROFILES = """\
|----------|-----------|---------|--------------|------|---------|--------|-------|--------|
| Profile  | VM Driver | Runtime |      IP      | Port | Version | Status | Nodes | Active |
|----------|-----------|---------|--------------|------|---------|--------|-------|--------|
| robots   | docker    | docker  | 192.168.49.2 | 8443 | v1.34.0 | OK     |     1 | *      |
|----------|-----------|---------|--------------|------|---------|--------|-------|--------|
"""


def cluster_command(*arguments: str) -> int:
    """Run `scripts/cluster` in this process, and return its exit code."""
    command, *rest = arguments
    return cli.main([command, "--provider", "current", *rest])


def node(name: str, ready: str | None = "True") -> dict[str, Any]:
    """A node as the API server has it; without a readiness, it has no conditions yet."""
    conditions = [{"type": "MemoryPressure", "status": "False"}, {"type": "Ready", "status": ready}]
    return {"kind": "Node", "metadata": {"name": name}, "status": {"conditions": conditions} if ready else {}}


@pytest.fixture
def kubeconfig(machine: FakeKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that KUBECONFIG names. The user's home has none."""
    path = tmp_path / "robots.conf"
    path.write_text("{}")
    monkeypatch.setenv("KUBECONFIG", str(path))
    monkeypatch.setenv("HOME", str(tmp_path))
    return path


@pytest.fixture
def kubectl(machine: FakeKind, kubeconfig: Path) -> FakeKubectl:
    """A cluster of two nodes that are ready, behind a stand-in for kubectl."""
    kubectl = FakeKubectl(machine.folder)
    kubectl.tell([node("a"), node("b")])
    return kubectl


def in_context(kubectl: FakeKubectl, name: str) -> None:
    """Let the kubeconfig have a current context."""
    kubectl.begin_with(f"if sys.argv[-2:] == ['config', 'current-context']: sys.exit(print({name!r}))")


# use of the cluster


def test_up_of_a_cluster_that_works_only_reads_its_nodes(
    kubectl: FakeKubectl, kubeconfig: Path, machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command("up") == 0
    assert kubectl.asked == [f"--kubeconfig={kubeconfig} get nodes -o json"]
    assert not machine.calls()
    assert f"the cluster of {kubeconfig}: 2 of 2 nodes are ready" in capsys.readouterr().err


def test_a_cluster_can_be_used_if_one_node_is_ready(kubectl: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    kubectl.tell([node("a"), node("b", "Unknown"), node("c", None)])
    assert cluster_command("status") == 0
    assert "1 of 3 nodes are ready" in capsys.readouterr().out


@pytest.mark.parametrize("ready", ["False", None])
def test_up_fails_without_a_node_that_is_ready(
    kubectl: FakeKubectl, ready: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    kubectl.tell([node("a", ready)])
    assert cluster_command("up") == 1
    assert "0 of 1 nodes are ready" in capsys.readouterr().err


@pytest.mark.parametrize(("command", "stream"), [("up", "err"), ("status", "out")])
def test_a_cluster_that_does_not_answer_is_reported_with_kubectls_reason(
    kubectl: FakeKubectl, kubeconfig: Path, command: str, stream: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kubectl.tell([], error="The connection to the server localhost:8080 was refused")
    assert cluster_command(command) == 1
    message = getattr(capsys.readouterr(), stream)
    assert f"the cluster of {kubeconfig} does not answer" in message
    assert "was refused" in message


def test_down_leaves_the_cluster_as_it_is(
    kubectl: FakeKubectl, machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cluster_command("down") == 0
    assert "left as it is" in capsys.readouterr().err
    assert not kubectl.asked
    assert not machine.calls()


@pytest.mark.parametrize(
    ("arguments", "operation"),
    [
        (("node", "down", "a"), "cut a node's power"),
        (("node", "up", "a"), "switch a node on"),
        (("node", "freeze", "a"), "freeze a node"),
        (("node", "thaw", "a"), "freeze a node"),
        (("node", "cut", "a"), "cut a node off"),
        (("node", "connect", "a"), "cut a node off"),
        (("node", "stop-runtime", "a"), "stop a node's kubelet"),
        (("network", "a", "--deaf"), "weaken a node's network"),
        (("api", "stop"), "stop the API server"),
        (("api", "start"), "start the API server"),
    ],
)
def test_every_fault_is_refused_with_the_provider_that_can_cause_it(
    kubectl: FakeKubectl,
    machine: FakeKind,
    arguments: tuple[str, ...],
    operation: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cluster_command(*arguments) == 1
    message = capsys.readouterr().err
    assert f"provider current cannot {operation}" in message
    assert "provider local can" in message
    assert not kubectl.asked
    assert not machine.calls()


def test_the_environment_selects_it(kubectl: FakeKubectl, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_PROVIDER", "current")
    assert cli.main(["status"]) == 0
    assert isinstance(cli.select("current", None, Progress()), CurrentProvider)


# the kubeconfig


def test_the_first_file_of_kubeconfig_that_exists_is_used(
    kubeconfig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KUBECONFIG", f"{tmp_path}/missing:{kubeconfig}:{tmp_path}/other")
    assert cluster_command("kubeconfig") == 0
    assert capsys.readouterr().out == f"{kubeconfig}\n"


@pytest.mark.parametrize("value", [None, ""])
def test_without_the_variable_the_users_own_kubeconfig_is_used(
    kubeconfig: Path,
    tmp_path: Path,
    value: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if value is None:
        monkeypatch.delenv("KUBECONFIG")
    else:
        monkeypatch.setenv("KUBECONFIG", value)
    assert cluster_command("kubeconfig") == 1
    assert "name one in KUBECONFIG" in capsys.readouterr().err
    (tmp_path / ".kube").mkdir()
    kubeconfig.rename(tmp_path / ".kube" / "config")
    assert cluster_command("kubeconfig") == 0
    assert capsys.readouterr().out == f"{tmp_path}/.kube/config\n"


def test_a_file_that_is_missing_is_not_replaced_by_the_users_own_kubeconfig(
    kubectl: FakeKubectl, kubeconfig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".kube").mkdir()
    kubeconfig.rename(tmp_path / ".kube" / "config")
    for command in ("kubeconfig", "up", "status"):
        assert cluster_command(command) == 1
        assert f"KUBECONFIG={kubeconfig}" in capsys.readouterr().err
    assert not kubectl.asked, "tests would install their chart in a cluster that nobody named"


def test_without_kubectl_the_message_says_where_it_comes_from(
    kubeconfig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (("up",), ("status",), ("load-image", "thing:dev")):
        assert cluster_command(*arguments) == 1
        assert "the program `kubectl` is missing; it comes with your cluster's tools" in capsys.readouterr().err


# images


def test_images_for_a_context_of_kind_are_loaded_with_kind(
    kubectl: FakeKubectl, cluster: FakeKind, tmp_path: Path
) -> None:
    in_context(kubectl, "kind-understudy")
    cluster.load()["images"]["thing:dev"] = "sha256:1"
    cluster.save()
    archive = tmp_path / "thing.tar"
    archive.touch()
    assert cluster_command("load-image", "thing:dev", str(archive)) == 0
    assert cluster.calls("kind load") == [
        "kind load docker-image --name understudy thing:dev",
        f"kind load image-archive --name understudy {archive}",
    ]


def test_an_image_that_kind_cannot_load_has_kinds_reason(
    kubectl: FakeKubectl, cluster: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    in_context(kubectl, "kind-understudy")
    assert cluster_command("load-image", "thing:dev") == 1
    assert 'image: "thing:dev" not present locally' in capsys.readouterr().err


def test_images_for_a_context_of_minikube_are_loaded_with_minikube(kubectl: FakeKubectl, machine: FakeKind) -> None:
    in_context(kubectl, "robots")
    minikube = machine.folder / "minikube"
    minikube.write_text(f"#!/bin/sh\necho minikube $* >>{minikube}.calls\n[ $1 != profile ] || echo '{PROFILES}'\n")
    minikube.chmod(0o755)
    assert cluster_command("load-image", "thing:dev") == 0
    calls = minikube.with_suffix(".calls").read_text().splitlines()
    assert calls[-1] == "minikube --profile robots image load thing:dev"
    assert not machine.calls()


@pytest.mark.parametrize("context", ["admin@production", "kind-understudy"])
def test_for_another_context_or_without_kind_a_registry_is_the_way(
    kubectl: FakeKubectl, machine: FakeKind, context: str, capsys: pytest.CaptureFixture[str]
) -> None:
    in_context(kubectl, context)
    machine.remove("kind")
    assert cluster_command("load-image", "thing:dev") == 1
    message = capsys.readouterr().err
    assert f"context {context}" in message
    assert "push it to a registry" in message


# with the real kubectl


class ApiServer(BaseHTTPRequestHandler):
    """As much of an API server as listing nodes takes."""

    nodes: ClassVar[list[dict[str, Any]]] = []
    resources: ClassVar[list[dict[str, Any]]] = [
        {"name": "nodes", "singularName": "node", "namespaced": False, "kind": "Node", "verbs": ["get", "list"]}
    ]
    methods: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        """Answer what kubectl reads."""
        answers: dict[str, dict[str, Any]] = {
            "/api": {"kind": "APIVersions", "versions": ["v1"]},
            "/apis": {"kind": "APIGroupList", "apiVersion": "v1", "groups": []},
            "/api/v1": {"kind": "APIResourceList", "groupVersion": "v1", "resources": self.resources},
            "/api/v1/nodes": {"kind": "NodeList", "apiVersion": "v1", "metadata": {}, "items": self.nodes},
        }
        answer = answers.get(self.path.partition("?")[0])
        body = json.dumps(answer).encode()
        self.send_response(200 if answer else 404)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Keep the methods of all requests instead."""
        self.methods.append(self.command)


@pytest.fixture
def server(kubeconfig: Path) -> Iterator[type[ApiServer]]:
    """A server that the kubeconfig names."""
    handler = type("Handler", (ApiServer,), {"nodes": [{"apiVersion": "v1", **node("a")}], "methods": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        cluster = {"name": "lab", "cluster": {"server": f"http://127.0.0.1:{server.server_port}"}}
        context = {"name": "lab", "context": {"cluster": "lab", "user": "me"}}
        users = [{"name": "me", "user": {"token": "nobody"}}]
        config = {"clusters": [cluster], "contexts": [context], "users": users, "current-context": "lab"}
        kubeconfig.write_text(json.dumps({"apiVersion": "v1", "kind": "Config", **config}))
        yield handler
        server.shutdown()


KUBECTL = shutil.which("kubectl")


@pytest.mark.skipif(KUBECTL is None, reason="there is no kubectl")
def test_the_real_kubectl_reads_the_nodes_of_the_kubeconfigs_cluster(
    server: type[ApiServer], machine: FakeKind, capsys: pytest.CaptureFixture[str]
) -> None:
    (machine.folder / "kubectl").symlink_to(str(KUBECTL))
    assert cluster_command("up") == 0
    assert "1 of 1 nodes are ready" in capsys.readouterr().err
    assert set(server.methods) == {"GET"}
    assert cluster_command("load-image", "thing:dev") == 1
    assert "context lab" in capsys.readouterr().err
