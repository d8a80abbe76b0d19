"""The paper's fault, by the example's own processes on real DDS: the commands are remapped, and all but the camera finds that well."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.unit.dds import isolate_discovery

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("rendering")]

REPOSITORY = Path(__file__).parents[3]
MANIFESTS = REPOSITORY / "examples/tracker/manifests"
WITHIN = 30.0


class Running:
    """Processes whose output is kept, line by line."""

    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[str]] = []

    def start(self, *command: str, **environment: str) -> tuple[subprocess.Popen[str], list[str]]:
        paths = os.pathsep.join(str(REPOSITORY / path) for path in ("operator", "examples/tracker/src"))
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            env={**os.environ, "PYTHONPATH": paths, "LP_NUM_THREADS": "0", **environment},
            stdout=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        lines: list[str] = []
        threading.Thread(target=self._keep, args=(process, lines), daemon=True).start()
        return process, lines

    @staticmethod
    def _keep(process: subprocess.Popen[str], lines: list[str]) -> None:
        assert process.stdout is not None
        lines.extend(iter(process.stdout.readline, ""))
        process.stdout.close()

    def end(self) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    isolate_discovery(monkeypatch)
    found = Running()
    yield found
    found.end()


@pytest.fixture
def watching(running: Running) -> Iterator[Any]:
    from understudy.ros.observe.topic_watch import TopicWatch
    from understudy.ros.runtime.graph_node import Graph

    graph = Graph("tested")
    made = TopicWatch(graph)
    yield made
    made.close()
    graph.close()


def eventually(holds: Callable[[], object], what: str) -> None:
    end = time.monotonic() + WITHIN
    while not holds():
        assert time.monotonic() < end, f"not within {WITHIN:g} s: {what}"
        time.sleep(0.02)


def test_only_the_camera_detects_a_robot_that_stands_due_to_a_wrong_remapping(
    running: Running, watching: Any, tmp_path: Path
):
    from understudy_demo import robotview

    from tests.unit.ros.judged_tree import Judged

    policy, _ = yaml.safe_load_all((MANIFESTS / "policy.yaml").read_text())
    configured, _ = yaml.safe_load_all((MANIFESTS / "tracker.yaml").read_text())
    file = tmp_path / "tracker.yaml"
    file.write_text(configured["data"]["tracker.yaml"])
    tree = policy["spec"]["monitoring"]["yaml"]
    for leaf in tree["parallel"]:
        if "topic" in leaf:
            leaf["topic"]["gap"] = "3s"  # which a busy machine may take
    judged = Judged(watching, tree)
    _, lines = running.start("tracker_robot")
    running.start("understudy.main", "tracker", str(file))

    def log() -> robotview.RobotLog:
        return robotview.parse(lines[-200:])

    def drives() -> bool:
        return bool((motions := log().motions) and motions[-1].speed > 0.25 and motions[-1].y < 0.2)

    def poses() -> int:
        judged.now()
        return watching.topic("/tracker/robot/odometry").count

    eventually(poses, "the robot, which stands, is seen")
    first, _ = running.start("tracker_application", HOSTNAME="first")
    eventually(lambda: judged.now().state == "Healthy" and drives(), "it is driven, and all is well")

    first.send_signal(signal.SIGUSR1)
    eventually(lambda: judged.now().state == "Failed", "the robot is seen to stand")
    verdict = judged.now()
    assert re.fullmatch(
        r"the robot does not move as /cmd_vel_nav commands, according to /tracker/robot/odometry: (forward|turning) .*",
        verdict.reason,
    ), "what is inside is well"
    end = log().motions[-1]
    assert abs(end.speed) < 0.03
    commands = [c for c in log().of("first") if c.received > time.time() - 2.0][-5:]
    assert len(commands) == 5
    assert {(c.linear, c.angular) for c in commands} == {(0.0, 0.0)}, "and commands go on to come to the robot"

    first.kill()
    running.start("tracker_application", HOSTNAME="second")
    eventually(lambda: judged.now().state == "Healthy" and drives() and log().of("second"), "a new instance drives it")
