"""``understudy timeline`` and ``understudy explain``: what they ask kubectl and how they end; and what the page shows of all."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden, assert_shown
from understudy.cli.completion import command as completion
from understudy.cli.control import fence, pause, resume, robot_profile
from understudy.cli.doctor import command as doctor
from understudy.cli.inject import command as inject
from understudy.cli.inspect import explain, status, timeline

REPOSITORY = Path(__file__).parents[3]
COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "status": status.main,
    "timeline": timeline.main,
    "explain": explain.main,
    "pause": pause.main,
    "resume": resume.main,
    "doctor": doctor.main,
    "fence": fence.main,
    "inject": inject.main,
    "robot-profile": robot_profile.main,
    "completion": completion.main,
}


def test_timeline_shows_the_last_recoveries(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    assert timeline.main(["robot-17-navigation", "-n", "fleet", "--last", "1"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("fleet/robot-17-navigation: 3 recoveries\n")
    assert output.count("recovered in") == 1
    assert stand.asked[0].startswith("--namespace=fleet get robotworkloads.understudy.dev robot-17-navigation -o json")


@pytest.mark.parametrize("count", ["0", "-1", "all"])
def test_the_number_of_recoveries_must_be_at_least_one(capsys: pytest.CaptureFixture[str], count: str) -> None:
    with pytest.raises(SystemExit) as ended:
        timeline.main(["robot-17-navigation", f"--last={count}"])
    assert ended.value.code == 2
    assert f"argument --last: found '{count}'; give a whole number of at least 1" in capsys.readouterr().err


def test_timeline_prints_the_records_as_json(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert timeline.main(["robot-17-navigation", "-o", "yaml"]) == 0
    written = yaml.safe_load(capsys.readouterr().out)
    assert timeline.main(["robot-17-navigation", "-o", "json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output == written
    assert output["recoveries"] == fleet.well()["status"]["recoveries"]
    assert (output["namespace"], output["name"], output["recoveryCount"]) == ("fleet", "robot-17-navigation", 3)


def test_explain_reads_the_objects_around_the_robot(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    item = fleet.well()
    stand.tell([*fleet.around(item), fleet.event(9, "GateBlocked", "Packets of w-2")])
    assert explain.main(["robot-17-navigation"]) == 0
    output = capsys.readouterr().out
    assert "✓ 1. Fallback from pool navigation-hot would run" in output
    assert "9s ago  GateBlocked" in output
    assert "involvedObject.kind=RobotWorkload,involvedObject.name=robot-17-navigation" in stand.asked[-1]
    assert not any("configmaps" in line for line in stand.asked), "the policy has its tree in it"
    stand.tell([i for i in fleet.around(item) if "monitor" not in i["metadata"]["name"]])
    assert explain.main(["robot-17-navigation"]) == 1


def test_explain_uses_the_existing_pods_instead_of_an_outdated_status(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    # Its standby is in control now, and no status says yet that no other standby is left.
    item = fleet.well()
    statuses = {one["type"]: one["status"] for one in item["status"]["conditions"]}
    assert statuses["Protected"] == "True"
    found = [one for one in fleet.around(item) if one["metadata"]["name"] != "robot-17-navigation-w7h5k"]
    stand.tell(found)
    assert explain.main(["robot-17-navigation"]) == 1
    assert "✗ 1. Fallback from pool navigation-hot" in capsys.readouterr().out
    stand.tell(fleet.around(item))
    assert explain.main(["robot-17-navigation"]) == 0


@pytest.mark.parametrize(("output", "read"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_explain_prints_json(
    stand: FakeKubectl,
    capsys: pytest.CaptureFixture[str],
    in_the_present: None,
    output: str,
    read: Callable[[str], Any],
) -> None:
    item = fleet.unprotected()
    stand.tell([*fleet.around(item, standby_waits="ImagePullBackOff"), fleet.event(9, "GateBlocked", "Packets of w-2")])
    assert explain.main(["robot-19-navigation", "-o", output]) == 1
    printed_text = read(capsys.readouterr().out)
    assert (printed_text["namespace"], printed_text["name"], printed_text["health"]) == (
        "fleet",
        "robot-19-navigation",
        "Healthy",
    )
    assert (printed_text["protected"], printed_text["reason"], printed_text["active"]) == (
        False,
        "ImagePullBackOff",
        "robot-19-navigation-c5n8r",
    )
    assert [one["available"] for one in printed_text["strategies"]] == [False, True, True]
    assert printed_text["strategies"][1]["verifyWithin"] == "20s"
    assert printed_text["ifItFailedNow"][0]["state"] == "Failed"
    assert printed_text["missing"][0]["text"].startswith("not protected (ImagePullBackOff")
    assert printed_text["lately"] == [{"text": "9s ago  GateBlocked: Packets of w-2", "state": ""}]


def test_explain_requests_the_deployment_that_the_workload_refers_to(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    item = fleet.well()
    del item["spec"]["template"]
    item["spec"]["workloadRef"] = {"kind": "Deployment", "name": "nav2"}
    stand.tell(fleet.around(item))
    assert explain.main(["robot-17-navigation"]) == 0, "what was built before protects it still"
    assert_golden("command_line", capsys.readouterr().out, "ReferenceNotFound", "spec.workloadRef", '"nav2"')
    assert any("get deployments.apps nav2 --ignore-not-found" in line for line in stand.asked)


def test_explain_requests_the_config_map_of_the_health_tree(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = fleet.policy(monitoring={"configMapKeyRef": {"name": "trees", "key": "driving.yaml"}})
    item = fleet.well()
    stand.tell([*(i for i in fleet.around(item) if i["kind"] != "FailurePolicy"), policy])
    assert explain.main(["robot-17-navigation"]) == 1
    assert 'no ConfigMap "trees" with the label' in capsys.readouterr().out
    assert any("get configmaps -l understudy.dev/health-tree=true" in line for line in stand.asked)


def test_explain_requests_the_monitor_settings_if_the_policy_has_situations(stand: FakeKubectl) -> None:
    raised = {"name": "carrying", "when": {"task": {"action": "/carry"}}, "strategies": [{"type": "Restart"}]}
    item = fleet.well()
    stand.tell([*(i for i in fleet.around(item) if i["kind"] != "FailurePolicy"), fleet.policy(situations=[raised])])
    assert explain.main(["robot-17-navigation"]) == 0
    assert any("get configmaps robot-17-navigation-settings --ignore-not-found" in line for line in stand.asked)


@pytest.mark.parametrize("command", ["timeline", "explain", "pause", "resume"])
def test_a_missing_workload_is_reported(stand: FakeKubectl, capsys: pytest.CaptureFixture[str], command: str) -> None:
    more = ["--reason", "a new gripper"] if command == "pause" else []
    assert COMMANDS[command](["robot-2", *more]) == 2
    assert_golden(
        "command_line",
        capsys.readouterr().err,
        f"understudy {command}: ",
        "NotFound",
        "robotworkloads.understudy.dev",
        '"robot-2"',
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_the_exit_status(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        COMMANDS[command](["--help"])
    assert "Exit status: 0" in capsys.readouterr().out


def test_kubectl_finds_the_commands_as_a_plugin() -> None:
    scripts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts["kubectl-understudy"] == scripts["understudy"] == "understudy.main:main"


def test_the_pages_show_the_printed_output(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], in_the_present: None
) -> None:
    shown = [
        (page, *found)
        for page in (REPOSITORY / "README.md", REPOSITORY / "docs" / "console.md")
        for found in re.findall(r"```console\n\$ kubectl understudy (\w+) (.*?)\n(.*?)```", page.read_text(), re.DOTALL)
    ]
    assert [command for _, command, _, _ in shown] == ["status", "status", "timeline", "explain"]
    for page, command, arguments, expected in shown:
        item = fleet.unprotected()
        explained = fleet.around(item, standby_waits="ImagePullBackOff")
        stand.tell(explained if command == "explain" else fleet.fleet())
        COMMANDS[command](shlex.split(arguments))
        assert_shown(page, expected, capsys.readouterr().out)
