"""``understudy pause`` and ``understudy resume``: what they write, and what they refuse."""

from __future__ import annotations

import getpass

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.cli.control import pause, resume

ROBOT = "robot-17-navigation"


def test_pause_records_reason_owner_and_end(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    arguments = [ROBOT, "-n", "fleet", "--reason", "a new gripper", "--owner", "ann", "--for", "1h30m"]
    assert pause.main(arguments) == 0
    assert stand.item(ROBOT)["spec"]["pause"] == {
        "reason": "a new gripper",
        "owner": "ann",
        "until": "2026-11-22T15:36:24Z",
    }
    assert RobotWorkloadSpec.model_validate(stand.item(ROBOT)["spec"]).pause is not None
    output = capsys.readouterr().out
    assert_golden("control", output, "fleet/robot-17-navigation", "ann", "a new gripper", "2026-11-22 15:36:24")
    assert stand.asked[-1].startswith(
        "--namespace=fleet patch robotworkloads.understudy.dev robot-17-navigation --type=merge"
    )


def test_several_robots_are_paused_and_resumed_at_once(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    robots = [ROBOT, "rw/robot-18-navigation"]
    assert pause.main([*robots, "--reason", "floor is cleaned"]) == 0
    assert [stand.item(name)["spec"]["pause"]["reason"] for name in (ROBOT, "robot-18-navigation")] == [
        "floor is cleaned"
    ] * 2
    assert resume.main(robots) == 0
    assert not any("pause" in stand.item(name)["spec"] for name in (ROBOT, "robot-18-navigation"))
    assert len(capsys.readouterr().out.splitlines()) == 4


def test_a_server_dry_run_pauses_nothing(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert pause.main([ROBOT, "--reason", "a rehearsal", "--dry-run=server"]) == 0
    assert "pause" not in stand.item(ROBOT)["spec"]
    assert capsys.readouterr().out.endswith(" (server dry run: nothing was changed)\n")


def test_the_user_owns_a_pause_by_default_and_its_end_is_optional(stand: FakeKubectl) -> None:
    assert pause.main([ROBOT, "--reason", "a new gripper", "--until", "2099-01-01T00:00:00+01:00"]) == 0
    assert stand.item(ROBOT)["spec"]["pause"]["owner"] == getpass.getuser()
    assert pause.main([ROBOT, "--reason", "and a new arm"]) == 0
    assert "until" not in stand.item(ROBOT)["spec"]["pause"], "not that of the pause before"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--until", "tonight"], '--until "tonight": write a date, a time and a time zone (RFC 3339)'),
        (["--until", "2026-02-30T00:00:00Z"], '--until "2026-02-30T00:00:00Z": write a date'),
        (["--until", "2026-11-22T14:00:00Z"], "--until 2026-11-22T14:00:00Z is in the past"),
        (["--for", "30"], '--for "30": write a duration as a number with ms, s, m or h'),
        (["--owner", " "], "--owner is empty"),
    ],
)
def test_an_invalid_end_or_an_empty_reason_is_refused(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None, more: list[str], words: str
) -> None:
    assert pause.main([ROBOT, "--reason", "a new gripper", *more]) == 2
    assert f"understudy pause: {words}" in capsys.readouterr().err
    assert "pause" not in stand.item(ROBOT)["spec"]


def test_resume_removes_the_pause_and_records_its_time(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    assert pause.main([ROBOT, "--reason", "a new gripper", "--owner", "ann"]) == 0
    assert resume.main([ROBOT]) == 0
    item = stand.item(ROBOT)
    assert "pause" not in item["spec"]
    assert item["metadata"]["annotations"][names.RESUMED] == fleet.ago(0)
    assert "it was paused by ann: a new gripper." in capsys.readouterr().out
    assert resume.main([ROBOT]) == 0
    assert "it was not paused." in capsys.readouterr().out


def test_resume_records_who_and_why_if_given(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert resume.main([ROBOT, "--reason", "the gripper grips", "--owner", "bob"]) == 0
    assert stand.item(ROBOT)["metadata"]["annotations"][names.RESUMED_FOR] == "bob: the gripper grips"
    assert resume.main([ROBOT]) == 0
    assert names.RESUMED_FOR not in stand.item(ROBOT)["metadata"]["annotations"], "that was of the time before"
    assert resume.main([ROBOT, "--reason", " "]) == 2
    assert_golden("control", capsys.readouterr().err, "--reason")
