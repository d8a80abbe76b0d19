from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from understudy_demo.plot import draw
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Command, Motion, RobotLog
from understudy_demo.timeline import compare, render

from tests.support.golden import assert_golden

START = datetime(2024, 11, 21, 14, 2, 11, tzinfo=UTC).timestamp()
OLD, NEW = "robot-17-navigation-7k2xq", "robot-17-navigation-x8v2m"


def rfc3339(moment: float) -> str:
    return datetime.fromtimestamp(START + moment, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def entry(**changes: Any) -> dict[str, Any]:
    moments = {"lastHealthy": 0.0, "detected": 0.503, "decided": 0.504, "fenced": 0.509, "routed": 0.509}
    moments |= {"firstOutput": 0.54, "verified": 0.56} | changes.pop("moments", {})
    return {
        "id": "r1",
        "number": 3,
        "reason": "no /cmd_vel for 500 ms",
        "result": "Recovered",
        "strategy": "Fallback/Executing",
        "fromPod": OLD,
        "toPod": NEW,
        "epoch": 41,
        "recoverySeconds": 0.509,
        "parts": {"detection": 0.503, "cluster": 0.006, "startup": 0.0, "reinitialization": 0.0},
        "moments": {name: rfc3339(moment) for name, moment in moments.items()},
        "attempts": [{"strategy": "Fallback/Executing", "pod": NEW, "result": "Verified", "message": ""}],
    } | changes


def log(*spans: tuple[str, float, float]) -> RobotLog:
    """Commands at 20 Hz by source from one moment to another, after START."""
    commands = [
        Command(START + start + n / 20, source, 0, START + start + n / 20, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5)
        for source, start, end in spans
        for n in range(round((end - start) * 20) + 1)
    ]
    motions = [Motion(START + n / 10 - 3, 0.0, 0.0, 0.0, 0.5, 0.0, False) for n in range(80)]
    return RobotLog(sorted(commands, key=lambda c: c.received), motions)


def test_an_entry_of_the_status_is_parsed() -> None:
    recovered = Recovered.read(entry())
    assert recovered.parts == {"detection": 0.503, "cluster": 0.006, "startup": 0.0, "reinitialization": 0.0}
    assert recovered.moments["detected"] == pytest.approx(START + 0.503, abs=1e-5)
    assert recovered.start == pytest.approx(START)


def test_a_recovery_that_has_only_begun_is_parsed() -> None:
    recovered = Recovered.read({"id": "r", "reason": "x", "result": "Running", "moments": {"detected": rfc3339(1.0)}})
    assert recovered.start == pytest.approx(START + 1.0)
    assert recovered.earliest_switch is None
    assert "Running" in render(recovered, None)


def test_an_executing_standby_may_drive_after_the_decision() -> None:
    assert Recovered.read(entry()).earliest_switch == pytest.approx(START + 0.504, abs=1e-5)


def test_a_started_instance_may_drive_after_it_is_ready() -> None:
    moments = {"claimed": 0.51, "started": 1.2, "ready": 1.6, "routed": 1.61, "firstOutput": 1.65}
    assert Recovered.read(entry(moments=moments)).earliest_switch == pytest.approx(START + 1.6, abs=1e-5)


def test_a_standby_that_is_ready_again_after_the_switch_does_not_move_it() -> None:
    assert Recovered.read(entry(moments={"ready": 0.7})).earliest_switch == pytest.approx(START + 0.504, abs=1e-5)


def test_a_good_recovery_has_no_problems() -> None:
    recovered = Recovered.read(entry())
    handover = recovered.handover(log((OLD, -2.0, 0.0), (NEW, 0.54, 2.0)))
    assert recovered.problems(handover, strategy="Fallback/Executing") == []


@pytest.mark.parametrize(
    ("changes", "spans", "problem"),
    [
        (
            {"strategy": "Restart"},
            [(OLD, -2.0, 0.0), (NEW, 0.54, 2.0)],
            "by Restart where Fallback/Executing was expected",
        ),
        ({}, [(OLD, -2.0, 0.0)], f"no command of {NEW} reached the robot"),
        ({}, [(OLD, -2.0, 0.0), (NEW, 0.40, 2.0)], f"3 commands of {NEW} reached the robot before the switch"),
        ({}, [(OLD, -2.0, 1.0), (NEW, 0.54, 2.0)], "arrived for 0.460 s after the first"),
        (
            {"result": "Failed", "attempts": [{"strategy": "Restart", "result": "NotVerified", "message": "no pod"}]},
            [(OLD, -2.0, 0.0)],
            r"ended as Failed \(Restart: NotVerified, no pod\)",
        ),
    ],
)
def test_problems_are_reported(changes: dict[str, Any], spans: list[tuple[str, float, float]], problem: str) -> None:
    recovered = Recovered.read(entry(**changes))
    found = recovered.problems(recovered.handover(log(*spans)), strategy="Fallback/Executing")
    assert len(found) == 1
    assert re.search(problem, found[0]), found


def test_an_overlap_within_the_enforcement_time_is_reported_and_allowed() -> None:
    recovered = Recovered.read(entry())
    handover = recovered.handover(log((OLD, -2.0, 0.55), (NEW, 0.54, 2.0)))
    assert handover.overlap == pytest.approx(0.01, abs=1e-5)
    assert recovered.problems(handover) == []
    assert_golden("demo", render(recovered, handover), "1 command of", "up to 10 ms later", "…-7k2xq", "…-x8v2m")


def test_the_timeline_shows_parts_moments_and_the_robot() -> None:
    recovered = Recovered.read(entry())
    text = render(recovered, recovered.handover(log((OLD, -2.0, 0.0), (NEW, 0.54, 2.0))))
    lines = text.splitlines()
    assert lines[0].startswith("#3  ")
    assert lines[0].endswith("recovered in 509 ms by Fallback/Executing")
    assert "503 ms  no /cmd_vel for 500 ms" in lines[1]
    assert "6 ms  gate epoch 41: …-7k2xq → …-x8v2m" in lines[2]
    assert "detected +503 ms" in text
    assert_golden("demo", text, "fenced +509 ms", "recovered +560 ms", "no command for 540 ms", "31 ms after routed")


def test_the_timeline_counts_early_commands() -> None:
    recovered = Recovered.read(entry())
    text = render(recovered, recovered.handover(log((OLD, -2.0, 0.0), (NEW, -1.0, -0.9), (NEW, 0.54, 2.0))))
    assert "3 commands of …-x8v2m before the switch" in text


def test_recoveries_are_compared_at_one_scale() -> None:
    slow = entry(strategy="Restart", parts={"detection": 0.5, "cluster": 1.0, "startup": 0.5, "reinitialization": 0.0})
    fast, restart = compare([Recovered.read(entry()), Recovered.read(slow)], width=40).splitlines()[:2]
    assert restart.count("░") == 10
    assert restart.count("█") == 20
    assert restart.count("▓") == 10
    assert 9 <= fast.count("░") + fast.count("█") <= 11
    assert compare([]) == ""


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    file = tmp_path / "out" / "demo.png"
    draw(log((OLD, -2.0, 0.0), (NEW, 0.54, 4.0)), [Recovered.read(entry())], file, title="One failure")
    assert file.read_bytes().startswith(b"\x89PNG")
    assert file.stat().st_size > 10_000


def test_a_picture_without_commands_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw(RobotLog(), [Recovered.read(entry(result="Failed", parts=None))], tmp_path / "demo.png", title="None")
    assert (tmp_path / "demo.png").exists()


def test_handovers_can_be_written_as_json() -> None:
    recovered = Recovered.read(entry())
    handover = recovered.handover(log((OLD, -2.0, 0.0), (NEW, 0.54, 2.0))).to_json()
    assert json.loads(json.dumps(handover))["gapSeconds"] == pytest.approx(0.54, abs=1e-5)
