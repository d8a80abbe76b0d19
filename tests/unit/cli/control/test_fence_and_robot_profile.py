"""``understudy fence`` and ``robot-profile``: what they write, refuse and print."""

from __future__ import annotations

import io
import json
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.cli.control import fence, resume, robot_profile
from understudy.controller.pods import ros_environment
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord
from understudy.ros.rmw import MIDDLEWARE

ROBOT = "robot-17-navigation"
GATE = names.gate(ROBOT)
REASON = ["--reason", "it is in the wrong aisle", "--owner", "ann"]


# -- fence ------------------------------------------------------------------------------------------------------------


def test_fence_closes_the_gate_and_pauses_recovery(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    item = fleet.well()
    stand.tell(fleet.around(item))
    before = GateRecord.of(stand.item(GATE))
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    after = GateRecord.of(stand.item(GATE))
    assert (after.epoch, after.active, after.active_uid, after.recovery) == (before.epoch + 1, "", "", "")
    assert registry.DEFAULT.let_through(stand.item(GATE)) == ()
    pause = RobotWorkloadSpec.model_validate(stand.item(ROBOT)["spec"]).pause
    assert pause is not None
    assert (pause.reason, pause.owner, pause.until) == ("fenced: it is in the wrong aisle", "ann", None)
    output = capsys.readouterr().out
    assert output.startswith(
        f"fleet/{ROBOT}: gate closed at epoch 42 (fenced: {before.active}).\nThe workload is paused by ann: fenced: it is"
    )
    assert f"understudy resume {ROBOT}" in output
    written = [line for line in stand.asked if line.startswith("patch ")]
    assert "robotworkloads" in written[0], "a monitor that knows of no pause would open it again"


def test_a_server_dry_run_fences_nothing_and_asks_nothing(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell(fleet.around(fleet.well()))
    before = GateRecord.of(stand.item(GATE))
    assert fence.main([ROBOT, *REASON, "--dry-run=server"]) == 0
    assert GateRecord.of(stand.item(GATE)) == before
    assert "pause" not in stand.item(ROBOT)["spec"]
    assert capsys.readouterr().out.splitlines()[-1].endswith("(server dry run: nothing was changed)")


def test_fence_of_a_robot_with_a_mux_says_when_it_has_an_effect(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    item = fleet.muxed()
    stand.tell(fleet.around(item))
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    assert registry.of(item).let_through(stand.item(GATE)) == ()
    output = capsys.readouterr().out
    assert output.startswith(f"fleet/{ROBOT}: gate closed at epoch 42 (fenced: {ROBOT}-x8v2m).")
    assert "stop the mux" in output


def test_a_closed_gate_is_written_too_so_that_commits_under_way_are_refused(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell(fleet.around(fleet.well()))
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    assert_golden("control", capsys.readouterr().out.splitlines()[2], "closed at epoch 43")


def test_the_gate_names_the_generation_of_the_pause(stand: FakeKubectl) -> None:
    stand.tell(fleet.around(fleet.well()))
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    assert GateRecord.of(stand.item(GATE)).fenced == stand.item(ROBOT)["metadata"]["generation"] > 0


def test_resume_frees_a_gate_whatever_its_generation(stand: FakeKubectl) -> None:
    """A restored backup begins again at generation 1."""
    stand.tell(fleet.around(fleet.well()))
    assert fence.main([ROBOT, *REASON, "--yes"]) == 0
    assert resume.main([ROBOT]) == 0
    assert GateRecord.of(stand.item(GATE)).fenced == 0


@pytest.mark.parametrize("option", ["--reason", "--owner"])
def test_fence_requires_owner_and_reason(stand: FakeKubectl, capsys: pytest.CaptureFixture[str], option: str) -> None:
    stand.tell(fleet.around(fleet.well()))
    assert fence.main([ROBOT, *REASON, option, " ", "--yes"]) == 2
    assert_golden("control", capsys.readouterr().err, f"{option}")
    assert not any(line.startswith("patch ") for line in stand.asked)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (None, "give --yes to confirm"),
        ("n\n", "not confirmed; nothing was changed"),
        ("\n", "not confirmed; nothing was changed"),
    ],
)
def test_without_confirmation_nothing_is_written(
    stand: FakeKubectl,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    typed: str | None,
    words: str,
) -> None:
    stand.tell(fleet.around(fleet.well()))
    monkeypatch.setattr("sys.stdin", io.StringIO() if typed is None else Terminal(typed))
    assert fence.main([ROBOT, *REASON]) == 2
    assert words in capsys.readouterr().err
    assert not any(line.startswith("patch ") for line in stand.asked)


def test_the_user_can_confirm_in_a_terminal(stand: FakeKubectl, monkeypatch: pytest.MonkeyPatch) -> None:
    stand.tell(fleet.around(fleet.well()))
    monkeypatch.setattr("sys.stdin", Terminal("yes\n"))
    assert fence.main([ROBOT, *REASON]) == 0


def test_a_missing_gate_is_reported(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell([fleet.well()])
    assert fence.main([ROBOT, *REASON, "--yes"]) == 2
    assert f"{GATE} does not exist" in capsys.readouterr().err


# -- robot-profile ----------------------------------------------------------------------------------------------------


def given_out(item: dict[str, Any]) -> list[dict[str, Any]]:
    """What the operator writes for the robot's side."""
    spec = RobotWorkloadSpec.model_validate(item["spec"])
    environment = MIDDLEWARE.environment(spec.ros, "10.96.0.7")
    maps = ros_environment.config_maps(ROBOT, environment, spec.outputs, spec.gate, fleet.NAMESPACE)
    return [item, *maps]


def test_both_files_are_printed_with_their_paths(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell(given_out(fleet.well()))
    assert robot_profile.main([ROBOT, "--at", "/opt/robot/"]) == 0
    output = capsys.readouterr().out
    assert "# /opt/robot/ros.env\n" in output
    assert_golden("control", output, "FASTRTPS_DEFAULT_PROFILES_FILE=/opt/robot/profiles.xml")
    assert "ROS_DISCOVERY_SERVER=10.96.0.7:11811\n" in output
    assert '<data_reader profile_name="/cmd_vel">' in output
    assert "EnvironmentFile=/opt/robot/ros.env" in output
    assert "/cmd_vel at 7950" in output
    assert "1. spec.gate.robots" in output
    assert "the discovery server 10.96.0.7:11811" in output


def test_each_file_can_be_printed_alone_or_written(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    stand.tell(given_out(fleet.well()))
    assert robot_profile.main([ROBOT, "-o", "env"]) == 0
    env = capsys.readouterr().out
    assert all("=" in line for line in env.splitlines())
    assert robot_profile.main([ROBOT, "-o", "xml"]) == 0
    xml = capsys.readouterr().out
    assert xml.startswith("<?xml")
    assert robot_profile.main([ROBOT, "--write", str(tmp_path / "new")]) == 0
    assert (tmp_path / "new" / "ros.env").read_text() == env
    assert (tmp_path / "new" / "profiles.xml").read_text() == xml
    assert "On the robot, put both files into /etc/understudy" in capsys.readouterr().out
    for form in ("json", "yaml"):
        assert robot_profile.main([ROBOT, "-o", form]) == 0
        assert yaml.safe_load(capsys.readouterr().out)["ports"] == {"/cmd_vel": 7950}


def test_a_robot_with_its_own_address_and_discovery_server_gets_its_profile(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    item = fleet.well()
    item["spec"] |= {
        "gate": {"robots": ["10.20.17.4/32"]},
        "ros": {"discovery": {"mode": "External", "server": "10.20.0.5:11811"}},
    }
    stand.tell(given_out(item))
    assert robot_profile.main([ROBOT]) == 0
    output = capsys.readouterr().out
    assert_golden("control", output, "spec.gate.robots", "10.20.17.4/32", "10.20.0.5:11811")


def test_a_robot_with_a_mux_gets_the_environment_of_both_and_no_profile(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    stand.tell(given_out(fleet.muxed()))
    assert robot_profile.main([ROBOT]) == 0
    output = capsys.readouterr().out
    assert_golden("control", output, f"/etc/understudy/{ROBOT}/mux.env", f"{ROBOT}-mux", f"understudy-mux@{ROBOT}")
    assert MIDDLEWARE.settings_variable not in output
    assert robot_profile.main([ROBOT, "--write", str(tmp_path)]) == 0
    capsys.readouterr()
    # A shell reads the same as systemd, which also knows single quotes.
    shell = f'set -a; . {tmp_path}/mux.env; printf %s "${names.OUTPUTS_VARIABLE}"'
    outputs = subprocess.run(["sh", "-ec", shell], capture_output=True, text=True, check=True).stdout
    assert json.loads(outputs) == [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}]
    for line in (tmp_path / "mux.env").read_text().splitlines():
        assert re.fullmatch(r"""[A-Z_]+=([^\s'"\\]+|'[^'\\]*')""", line), "quoted as a whole, or not at all"
    assert "ROS_DISCOVERY_SERVER=10.96.0.7:11811\n" in (tmp_path / "ros.env").read_text()
    assert robot_profile.main([ROBOT, "-o", "xml"]) == 2
    assert "needs no profiles.xml" in capsys.readouterr().err


def test_without_a_profile_of_the_operator_nothing_is_printed(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell([fleet.well()])
    assert robot_profile.main([ROBOT]) == 2
    assert f"ConfigMap {ROBOT}-robot-env does not exist yet" in (capsys.readouterr().err)


def test_the_page_shows_the_output_for_a_robot_outside_the_cluster(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[4] / "docs/how-to/robot-outside-the-cluster.md").read_text()
    (manifest,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    ((line, shown),) = re.findall(r"```console\n\$ understudy robot-profile (.*?)\n(.*?)```", page, re.DOTALL)
    stand.tell(given_out(fleet.well() | {"spec": yaml.safe_load(manifest)["spec"]}))
    monkeypatch.chdir(tmp_path)
    assert robot_profile.main(shlex.split(line)) == 0
    assert capsys.readouterr().out == shown
