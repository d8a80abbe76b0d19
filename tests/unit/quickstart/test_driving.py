"""The two nodes as they run in their pods, as processes over loopback."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.unit import processes

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

SOURCES = Path(__file__).parents[3] / "examples" / "quickstart" / "src"


class Run(processes.Run):
    """One robot, and applications beside it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__(folder, stack, [SOURCES])
        self.robot = self.pod("robot-pod", "robot")

    def pod(self, name: str, module: str, **environment: str) -> subprocess.Popen[bytes]:
        return self.start(name, "-m", f"understudy_quickstart.{module}", HOSTNAME=name, **environment)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with ExitStack() as stack:
        yield Run(tmp_path, stack)


@pytest.mark.timeout(90)
def test_another_application_continues_to_drive_the_robot_from_where_it_is(run: Run) -> None:
    first = run.pod("drive-a", "application")
    run.wait("the robot passes the first waypoint", lambda: "to waypoint 2" in run.output("drive-a"), within=40)
    assert "map received after" in run.output("drive-a")
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

    run.pod("drive-b", "application")
    run.wait("another application moves it on", lambda: run.log().motions[-1].x > stopped + 0.5, within=30)
    assert "map received after" in run.output("drive-b"), "the map is latched"
    handover = run.log().handover("drive-a", "drive-b")
    assert handover.clean
    assert handover.gap is not None
    assert handover.gap > 0.5


@pytest.mark.timeout(60)
def test_an_application_sends_as_often_as_it_is_asked(run: Run) -> None:
    run.pod("drive-a", "application", DRIVE_HERTZ="100")
    run.wait("the robot is driven", lambda: len(run.log().commands) > 150, within=30)
    commands = run.log().commands[50:]
    rate = (len(commands) - 1) / (commands[-1].received - commands[0].received)
    assert 40 < rate < 120, "20 if it is not asked; a busy machine delays some"


@pytest.mark.timeout(60)
def test_robot_and_application_end_on_a_signal(run: Run) -> None:
    application = run.pod("drive-a", "application")
    run.wait("the robot is driven", lambda: len(run.log().commands) > 5, within=30)
    for process in (application, run.robot):
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    assert "Traceback" not in run.output("robot-pod") + run.output("drive-a")
