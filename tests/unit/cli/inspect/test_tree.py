"""``understudy tree``: what it asks kubectl, and what it tells. The monitor that answers is a server of the same kind."""

from __future__ import annotations

import asyncio
import json
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.fake_monitor import KUBECTL, READY, state
from tests.support.golden import assert_golden
from understudy.cli.inspect.tree import main
from understudy.process.http_pages import JSON, serve


class Cluster:
    """What the stand-in for kubectl tells, and what the monitor behind its forwarding says."""

    def __init__(self, folder: Path) -> None:
        self._settings, self.asked = folder / "settings.json", folder / "asked"
        self.state: dict[str, Any] = state()
        self.port: int | None = None
        self.tell()
        kubectl = folder / "kubectl"
        kubectl.write_text(KUBECTL.format(python=sys.executable, settings=str(self._settings), asked=str(self.asked)))
        kubectl.chmod(0o755)

    def tell(self, **more: Any) -> None:
        pod = {"metadata": {"name": "monitor-1"}, "status": READY}
        self._settings.write_text(json.dumps({"workload": {}, "pods": [pod], "port": self.port, **more}))


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    counted = iter(range(1, 100))

    def answer() -> tuple[int, str, str]:
        made.state["time"] = 100.0 + next(counted)
        return 200, json.dumps(made.state), JSON

    async def begin() -> asyncio.Server:
        return await serve({"/tree": answer}, 0, host="127.0.0.1")

    server = asyncio.run_coroutine_threadsafe(begin(), loop).result(20)
    made.port = server.sockets[0].getsockname()[1]
    made.tell()
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    yield made
    loop.call_soon_threadsafe(server.close)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(20)


def test_the_tree_is_printed_and_kubectl_gets_namespace_and_context(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["robot-1-drive", "-n", "fleet", "--context", "lab"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("fleet/robot-1-drive  Healthy\n")
    assert "  scan " in output
    assert "\x1b" not in output, "colours are for terminals"
    for line in cluster.asked.read_text().splitlines():
        assert line.startswith("--namespace=fleet --context=lab ")
    assert "-l understudy.dev/monitored=robot-1-drive,understudy.dev/component=monitor" in cluster.asked.read_text()


@pytest.mark.parametrize("form", ["json", "yaml"])
def test_json_output_is_the_answer_of_the_monitor(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    cluster.state = state(health="Failed")
    assert main(["robot-1-drive", "-o", form]) == 1, "a script learns that it isn't healthy"
    output = capsys.readouterr().out
    assert output.startswith("{") is (form == "json")
    assert yaml.safe_load(output) == cluster.state


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"workload": None}, 'robotworkloads.understudy.dev "robot-2" not found'),
        ({"pods": []}, "RobotWorkload robot-2 has no monitor; see why: kubectl describe robotworkload robot-2"),
        ({"pods": [{"metadata": {"name": "m"}, "status": {"phase": "Pending"}}]}, "the monitor of robot-2 is not ready (Pending)"),
        ({"port": None}, "the monitor cannot be reached: unable to forward port"),
        ({"port": 1}, "the monitor does not answer: "),
    ],
)  # fmt: skip
def test_an_obstacle_is_reported(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], more: dict[str, Any], words: str
) -> None:
    cluster.tell(**more)
    assert main(["robot-2"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("understudy tree: ")
    assert words in captured.err


def test_a_missing_kubectl_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["robot-1-drive"]) == 2
    assert "kubectl is not on the PATH; install it" in capsys.readouterr().err


def test_an_older_monitor_is_reported(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    begin: Callable[[], Any] = lambda: serve({"/ready": lambda: (200, "ok")}, 0, host="127.0.0.1")  # noqa: E731
    server = asyncio.run_coroutine_threadsafe(begin(), loop).result(20)
    cluster.tell(port=server.sockets[0].getsockname()[1])
    assert main(["robot-1-drive"]) == 2
    assert_golden("tree", capsys.readouterr().err, "upgrade the operator")
    loop.call_soon_threadsafe(server.close)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(20)
