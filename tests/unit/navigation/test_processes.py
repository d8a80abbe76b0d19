"""Robot and client as they run in their pods, as processes over loopback."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from navigation_world import generate

from tests.unit.navigation.processes import SEED, Run
from tests.unit.processes import stop

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("mujoco")

NODES = str(Path(__file__).with_name("nodes.py"))


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with ExitStack() as stack:
        yield Run(tmp_path, stack)


@pytest.mark.timeout(180)
def test_the_robot_follows_commands_and_stops_without_them(run: Run) -> None:
    run.start("listen", NODES, "listen")
    robot = run.start("robot", "-m", "navigation_robot")
    steer = run.start("steer", NODES, "steer", "0.0", "0.6")
    run.wait("the robot turns", lambda: any(m.turn > 0.5 for m in run.log().motions))
    keys = {"odom", "scan", "tf", "tf_static", "truth"}
    run.wait("everything is heard", lambda: any(keys <= record.keys() for record in run.records("listen")))
    run.wait("a standing watchdog has let go", lambda: not run.log().motions[-1].held)

    os.kill(steer.pid, signal.SIGSTOP)  # silent, and still in the graph
    run.wait("the watchdog holds it", lambda: run.log().motions[-1].held)
    run.wait("it stands", lambda: abs(run.log().motions[-1].turn) < 0.01)
    log = run.log()
    last = log.commands[-1].received
    held = next(m.time for m in log.motions if m.held and m.time > last)
    assert held - last > 0.4, "it was held before its time"

    other = run.start("other", NODES, "steer", "0.0", "-0.6")
    run.wait("another one turns it", lambda: run.log().motions[-1].turn < -0.5)
    records = [r for r in run.records("robot") if r["event"] == "command"]
    writers = list(dict.fromkeys(r["writer"] for r in records))
    assert len(writers) == 2, "each sender is told from the other"
    assert {r["writer"][:8] for r in records} == {r["source"] for r in records}
    assert [r["sequence"] for r in records] == list(range(1, len(records) + 1))
    assert all(0 <= r["received"] - r["sent"] < 5 for r in records)
    stop(other)

    received = run.records("listen")[-1]
    start = generate(SEED).start
    assert received["odom"][:2] == ["odom", "base_link"]
    assert received["scan"][:2] == ["laser", 360]
    assert received["scan"][2] == pytest.approx(math.pi)
    assert 0.1 <= received["scan"][4] < 8.0
    assert received["tf"][:2] == ["odom", "base_link"]
    assert received["tf_static"] == ["base_link", "laser", pytest.approx(-0.04), pytest.approx(0.2)]
    # It turned on the spot.
    assert received["truth"] == ["map", pytest.approx(start.x, abs=0.05), pytest.approx(start.y, abs=0.05)]

    robot.send_signal(signal.SIGTERM)
    assert robot.wait(20) == 0
    assert (run.folder / "robot.jsonl").read_text().startswith('{"event":"started"')


@pytest.mark.timeout(120)
def test_the_client_pursues_its_goals_and_reports_each_result(run: Run) -> None:
    run.start("navigate", NODES, "navigate", "no", "succeed", "abort", "succeed")
    client = run.start("client", "-m", "navigation_client", "--goals", "3", "--wait", "60")
    assert client.wait(90) == 1
    records = run.records("client")
    goals = generate(SEED).goals(3)
    assert [r["x"] for r in records if r["event"] == "goal"] == [pytest.approx(g.x) for g in goals]
    answers = [(r["number"], r["accepted"]) for r in records if r["event"] == "answer"]
    assert answers == [(1, False), (1, True), (2, True), (3, True)]
    results = [r for r in records if r["event"] == "result"]
    assert [r["status"] for r in results] == ["succeeded", "aborted", "succeeded"]
    assert [r["error_code"] for r in results] == [0, 9001, 0]
    assert results[1]["error_msg"] == "no way"
    # The last of it may be overtaken by the result.
    assert all(1 <= r["feedback"] <= 5 for r in results)
    assert records[-1]["event"] == "summary"
    assert (records[-1]["goals"], records[-1]["succeeded"], records[-1]["aborted"]) == (3, 2, 1)
    asked = [r for r in run.records("navigate") if "asked" in r]
    assert len(asked) == 4
    assert {r["frame"] for r in asked} == {"map"}
    assert [json.loads(line) for line in (run.folder / "client.jsonl").read_text().splitlines()] == records


@pytest.mark.timeout(60)
def test_the_client_ends_without_a_navigator(run: Run) -> None:
    client = run.start("client", "-m", "navigation_client", "--goals", "2", "--wait", "1")
    assert client.wait(40) == 1
    events = [r["event"] for r in run.records("client")]
    assert events == ["client", "no-server", "summary"]
    assert run.records("client")[-1]["succeeded"] == 0
