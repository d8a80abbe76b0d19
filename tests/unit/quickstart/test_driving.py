"""The two nodes as they run in their pods, as processes over loopback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from understudy_demo.robotview import RobotLog, parse

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

SOURCES = Path(__file__).parents[3] / "examples" / "quickstart" / "src"


class Run:
    """One robot, and applications beside it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self._stack = stack
        # A domain of its own for each run; 2 to 9 and 90 up are left to others.
        self._domain = str(10 + os.getpid() % 80)
        self.robot = self.start("robot", "robot-pod", ROBOT_LOG=str(folder / "robot.jsonl"))

    def start(self, module: str, pod: str, **more: str) -> subprocess.Popen[bytes]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "FASTRTPS_", "FASTDDS_"))} | {
            "PYTHONPATH": str(SOURCES),
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": self._domain,
            "HOSTNAME": pod,
        }
        output = self._stack.enter_context(self.output(pod).open("wb"))
        process = subprocess.Popen(
            [sys.executable, "-m", f"understudy_quickstart.{module}"],
            env=environment | more,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        self._stack.callback(stop, process)
        return process

    def output(self, pod: str) -> Path:
        return self.folder / f"{pod}.out"

    def log(self) -> RobotLog:
        file = self.folder / "robot.jsonl"
        return parse(file.read_text() if file.exists() else "")

    def wait(self, what: str, condition: Callable[[], object], *, within: float) -> None:
        end = time.monotonic() + within
        while not condition():
            if time.monotonic() > end:
                outputs = "\n".join(f"{f.name}:\n{f.read_text()[-1500:]}" for f in self.folder.glob("*.out"))
                pytest.fail(f"not within {within} s: {what}\n{outputs}")
            time.sleep(0.1)


def stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait(10)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with ExitStack() as stack:
        yield Run(tmp_path, stack)


@pytest.mark.timeout(90)
def test_the_application_drives_the_robot_and_another_goes_on_from_there(run: Run) -> None:
    first = run.start("application", "drive-a")
    run.wait(
        "the robot passes the first waypoint", lambda: "to waypoint 2" in run.output("drive-a").read_text(), within=40
    )
    assert "map received after" in run.output("drive-a").read_text()
    log = run.log()
    assert log.sources() == ["drive-a"]
    there = log.motions[-1]
    assert (there.x, there.y) == (pytest.approx(4.0, abs=0.3), pytest.approx(1.0, abs=0.3))
    assert there.speed > 0.3
    assert "bumped" not in (run.folder / "robot.jsonl").read_text()
    rate = len(log.commands) / (log.commands[-1].received - log.commands[0].received)
    assert 15 < rate < 25
    assert all(abs(c.received - c.sent) < 1.0 for c in log.commands)
    assert [c.sequence for c in log.commands] == list(range(1, len(log.commands) + 1))

    first.send_signal(signal.SIGKILL)
    run.wait("the robot stops by itself", lambda: run.log().motions[-1].speed == 0.0, within=10)
    assert run.log().motions[-1].held
    stopped = run.log().motions[-1].x

    run.start("application", "drive-b")
    run.wait("another application moves it on", lambda: run.log().motions[-1].x > stopped + 0.5, within=30)
    assert "map received after" in run.output("drive-b").read_text(), "the map is latched"
    handover = run.log().handover("drive-a", "drive-b")
    assert handover.clean
    assert handover.gap is not None
    assert handover.gap > 0.5


@pytest.mark.timeout(60)
def test_both_end_when_they_are_told_to(run: Run) -> None:
    application = run.start("application", "drive-a")
    run.wait("the robot is driven", lambda: len(run.log().commands) > 5, within=30)
    for process in (application, run.robot):
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    assert "Traceback" not in run.output("robot-pod").read_text() + run.output("drive-a").read_text()
