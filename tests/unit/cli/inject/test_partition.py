"""``understudy inject partition``: what is put into the pod really cuts a network namespace off; the cluster is a stand-in for it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from tests.support.network_namespaces import network
from understudy.cli.inject import command as inject
from understudy.cli.inject import partition

ROBOT = "robot-17-navigation"
ALLOWED = {"kind": "Namespace", "metadata": {"name": "fleet", "labels": {inject.ALLOWED: "true"}}}
REPOSITORY = Path(__file__).parents[4]

KUBECTL = """#!{python}
import http.server, json, os, subprocess, sys, time
from pathlib import Path
folder = Path({folder!r})
given = sys.argv[1:]
cluster = json.loads((folder / "cluster.json").read_text())
if "logs" in given:
    made = json.loads((folder / "made.json").read_text())
    environment = {{**os.environ, **{{entry["name"]: entry["value"] for entry in made["env"]}}}}
    os.dup2(1, 2)
    os.execvpe((cluster["inside"] + made["command"])[0], cluster["inside"] + made["command"], environment)
if "exec" in given:
    os.execvp("sh", given[given.index("--") + 1 :])
if "proxy" not in given:
    os.execv({others!r}, [{others!r}, *given])

class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        made = folder / "made.json"
        status = {{}}
        if made.exists():
            name = json.loads(made.read_text())["name"]
            status = {{"ephemeralContainerStatuses": [{{"name": name, "state": cluster["state"]}}]}}
        self.answer(200, {{"spec": cluster["spec"], "status": status}})

    def do_PATCH(self):
        text = self.rfile.read(int(self.headers["Content-Length"]))
        code, message = cluster["refusal"]
        if code == 200:
            assert self.path.endswith("/ephemeralcontainers")
            assert self.headers["Content-Type"] == "application/strategic-merge-patch+json"
            (made,) = json.loads(text)["spec"]["ephemeralContainers"]
            (folder / "made.json").write_text(json.dumps(made))
        self.answer(code, {{"message": message}})

    def address_string(self):
        return "here"

    def log_message(self, *_):
        pass

    def answer(self, code, body):
        text = json.dumps(body).encode()
        self.send_response(code)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

import socketserver
path = next(a for a in given if a.startswith("--unix-socket=")).partition("=")[2]
with socketserver.UnixStreamServer(path, Handler) as server:
    print("Starting to serve on " + path, flush=True)
    server.serve_forever(poll_interval=0.05)
"""


class Cluster:
    """A pod that a container can be put into; what the container says is what its program says on this machine."""

    def __init__(self, folder: Path, others: Path) -> None:
        self._folder = folder
        program = folder / "kubectl"
        program.write_text(KUBECTL.format(python=sys.executable, folder=str(folder), others=str(others)))
        program.chmod(0o755)
        self.tell()

    def tell(
        self,
        *,
        inside: list[str] | None = None,
        spec: dict[str, Any] | None = None,
        state: dict[str, Any] | None = None,
        refusal: tuple[int, str] = (200, ""),
    ) -> None:
        """``inside`` is what gets a program into the pod's network; ``state`` is the container's."""
        settings = {"inside": inside or [], "spec": spec or {}, "state": state or {"running": {}}, "refusal": refusal}
        (self._folder / "cluster.json").write_text(json.dumps(settings))

    @property
    def made(self) -> dict[str, Any] | None:
        """The container that was put into the pod."""
        path = self._folder / "made.json"
        found: dict[str, Any] | None = json.loads(path.read_text()) if path.exists() else None
        return found


def protected() -> list[dict[str, Any]]:
    """A workload, its monitor's pod, and its namespace."""
    item = fleet.well()
    monitor = next(one for one in fleet.around(item) if one["metadata"]["name"] == f"{ROBOT}-monitor-1")
    monitor |= {
        "spec": {
            "containers": [{"name": "monitor", "image": "registry/monitor:1", "imagePullPolicy": "Never"}],
        },
        "status": {"podIPs": [{"ip": "10.91.0.3"}, {"ip": "fd00::3"}]},
    }
    return [item, monitor, ALLOWED]


@pytest.fixture
def cluster(stand: FakeKubectl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    stand.tell(protected())
    (tmp_path / "cluster").mkdir()
    made = Cluster(tmp_path / "cluster", tmp_path / "kubectl")
    monkeypatch.setenv("PATH", str(tmp_path / "cluster"), prepend=":")
    return made


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="takes root, for network namespaces")


def without_id(text: str) -> str:
    """What was said, without the random end of the container's name."""
    return re.sub(r"partition-\w{6}", "partition-ID", text)


@needs_root
def test_the_pod_is_cut_off_for_the_given_time(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    with network() as lan:
        cluster.tell(inside=lan.host("10.91.0.1"))
        assert inject.main([ROBOT, "partition", "--for", "500ms", "--yes"]) == 0
    output, pod = capsys.readouterr().out.splitlines(), fleet.well()["status"]["active"]
    assert cluster.made is not None
    cut, again, further = output
    assert cut == f"{pod}: container {cluster.made['name']} cut it off from the network, for 0.5 s"
    (after,) = re.findall(rf"^{pod}: it is connected again after ([\d.]+) s$", again)
    assert float(after) >= 0.5, "it is told how long that was, which on a busy machine is longer"
    assert_golden("inject", further, f"understudy timeline -n fleet {ROBOT}")


@needs_root
def test_a_pod_can_be_cut_off_from_its_monitor_and_given_networks_only(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    with network() as lan:
        cluster.tell(inside=lan.host("10.91.0.1"))
        whom = ["--from", "monitor", "--from", "10.91.7.0/24"]
        assert inject.main([ROBOT, "partition", *whom, "--for", "200ms", "--yes"]) == 0
    cut, *_ = capsys.readouterr().out.splitlines()
    assert_golden("inject", without_id(cut), "10.91.0.3", "fd00::3", "10.91.7.0/24", "0.2 s")


@needs_root
def test_ctrl_c_reconnects_the_pod_at_once(cluster: Cluster) -> None:
    with network() as lan:
        cluster.tell(inside=lan.host("10.91.0.1"))
        command = [sys.executable, "-m", "understudy", "inject", ROBOT, "partition", "--for", "60s", "--yes"]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as running:
            assert running.stdout is not None, "it is a pipe"
            assert "cut it off from the network, for 60 s" in running.stdout.readline()
            cut = time.monotonic()
            running.send_signal(signal.SIGINT)
            assert "it is connected again" in running.stdout.read()
    assert running.returncode == 0
    assert time.monotonic() - cut < 50


def test_the_container_has_the_image_of_the_monitor_and_one_capability(cluster: Cluster) -> None:
    cluster.tell(inside=["true"])
    inject.main([ROBOT, "partition", "--yes"])
    assert cluster.made is not None
    assert (cluster.made["image"], cluster.made["imagePullPolicy"]) == ("registry/monitor:1", "Never")
    assert not any("$" in argument for argument in cluster.made["command"]), "a kubelet puts variables in there"
    allowed = cluster.made["securityContext"]
    assert allowed["capabilities"] == {"drop": ["ALL"], "add": ["NET_ADMIN"]}
    assert not allowed["allowPrivilegeEscalation"]


def test_an_error_of_the_container_is_reported(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    cluster.tell(inside=["sh", "-c", "echo it is no network to cut off; exit 1"])
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    assert "was not cut off: it is no network to cut off" in capsys.readouterr().err
    cluster.tell(state={"terminated": {"exitCode": 1, "message": "the node's kernel does not support it\n"}})
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    assert_golden("inject", capsys.readouterr().err, "not cut off")


def test_a_pod_that_a_recovery_deletes_before_its_log_is_read_was_cut_off(
    cluster: Cluster, stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.tell(inside=["sh", "-c", "exit 1"])
    assert inject.main([ROBOT, "partition", "--yes"]) == 0
    assert_golden("inject", without_id(capsys.readouterr().out), "deleted")
    metadata = {"name": fleet.well()["status"]["active"]}
    stand.tell([*protected(), {"kind": "Pod", "metadata": metadata | {"deletionTimestamp": "2026-11-26T10:00:00Z"}}])
    cluster.tell(inside=["sh", "-c", "echo unable to retrieve container logs for containerd://79d2"])
    assert inject.main([ROBOT, "partition", "--yes"]) == 0
    capsys.readouterr()
    stand.tell([*protected(), {"kind": "Pod", "metadata": metadata}])
    cluster.tell(inside=["sh", "-c", "exit 1"])
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    assert "was not cut off: its container ended without a message" in capsys.readouterr().err


def test_a_container_that_does_not_start_is_reported_and_cuts_nothing_later(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(partition, "START_WITHIN", 1.0)
    cluster.tell(state={"waiting": {"reason": "ImagePullBackOff", "message": "manifest unknown"}})
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    error = capsys.readouterr().err
    assert_golden("inject", without_id(error), "1 s", "ImagePullBackOff")
    assert cluster.made is not None
    (latest,) = cluster.made["env"]
    assert float(latest["value"]) < time.time() + 2


POD_SECURITY = (
    'pods "robot-17-navigation-x8v2m" is forbidden: violates PodSecurity "baseline:latest": non-default capabilities '
    '(container "partition-1a2b3c" must not include "NET_ADMIN" in securityContext.capabilities.add)'
)
RIGHTS = (
    'pods "robot-17-navigation-x8v2m" is forbidden: User "ann" cannot patch resource "pods/ephemeralcontainers" in API '
    'group "" in the namespace "fleet"'
)


@pytest.mark.parametrize(
    ("refusal", "words"),
    [
        (POD_SECURITY, "kubectl label --overwrite namespace fleet pod-security.kubernetes.io/enforce=privileged"),
        (RIGHTS, "requires permission to patch pods/ephemeralcontainers"),
    ],
)
def test_a_refusal_of_the_cluster_is_reported_with_a_cure(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], refusal: str, words: str
) -> None:
    cluster.tell(refusal=(403, refusal))
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert refusal in error
    assert cluster.made is None


def test_a_pod_in_the_host_network_is_not_cut_off(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    cluster.tell(spec={"hostNetwork": True})
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    assert_golden("inject", capsys.readouterr().err, "(hostNetwork)")
    assert cluster.made is None


@pytest.mark.parametrize("whom", ["the robot", "10.0.0.7/24", "robot-1"])
def test_the_peers_must_be_given_as_addresses(cluster: Cluster, capsys: pytest.CaptureFixture[str], whom: str) -> None:
    assert inject.main([ROBOT, "partition", "--from", whom, "--yes"]) == 2
    assert f'--from "{whom}": write monitor, an address, or a network' in capsys.readouterr().err


def test_without_a_monitor_there_is_no_image(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell([fleet.well(), ALLOWED])
    assert inject.main([ROBOT, "partition", "--yes"]) == 2
    assert f"{ROBOT} has no monitor pod" in capsys.readouterr().err
