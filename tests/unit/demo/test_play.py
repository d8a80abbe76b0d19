"""The demo's own conduct: what it runs and what it says when that fails, with programs that stand in for kubectl."""

from __future__ import annotations

import os
import stat
import subprocess
from pathlib import Path

import pytest
import yaml
from understudy_demo.__main__ import _returns, main
from understudy_demo.kubectl import CommandFailed, Kubectl, run
from understudy_demo.play import MANIFESTS, STRATEGIES, NotSo, Play, _state, _why, _with_policy
from understudy_demo.robotview import Command, RobotLog

REPOSITORY = Path(__file__).parents[3]


def command(received: float, source: str) -> Command:
    return Command(received, source, 0, received, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5)


def program(folder: Path, name: str, script: str) -> None:
    file = folder / name
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def tools(tmp_path: Path) -> dict[str, str]:
    """An environment in which programs put into ``tmp_path`` come first."""
    return dict(os.environ) | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_workload_is_applied_with_the_policy_of_the_strategy(strategy: str) -> None:
    changed = _with_policy((MANIFESTS / "robotworkload.yaml").read_text(), strategy)
    policy = yaml.safe_load(changed)["spec"]["failurePolicyRef"]["name"]
    kinds = list(yaml.safe_load_all((MANIFESTS / "strategies" / f"{strategy}.yaml").read_text()))
    assert policy in {m["metadata"]["name"] for m in kinds if m["kind"] == "FailurePolicy"}


def test_a_manifest_without_a_policy_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one failurePolicyRef"):
        _with_policy("spec: {}", "restart")


def test_two_simultaneously_driving_pods_are_a_problem() -> None:
    overlapping = RobotLog([command(n / 20, "ba"[n % 2]) for n in range(40)])
    (problem,) = _returns(overlapping)
    assert "two pods drove the robot at once for up to 1.85" in problem


def test_a_late_command_within_the_enforcement_time_is_not_a_problem() -> None:
    assert _returns(RobotLog([command(1.0, "a"), command(1.01, "b"), command(1.03, "a"), command(1.06, "b")])) == []


def test_a_failed_command_is_reported_with_its_output(tools: dict[str, str], tmp_path: Path) -> None:
    program(tmp_path, "kubectl", "echo 'pods \"x\" not found' >&2; exit 1")
    with pytest.raises(CommandFailed, match=r'kubectl -n ns get pods x: pods "x" not found'):
        Kubectl("ns", tools)("get", "pods", "x")


def test_a_missing_or_a_slow_program_is_a_failed_command(tools: dict[str, str]) -> None:
    with pytest.raises(CommandFailed, match="there is no no-such-program"):
        run(["no-such-program"], tools)
    with pytest.raises(CommandFailed, match=r"not done within 0\.1 s"):
        run(["sleep", "5"], tools, timeout=0.1)


def test_an_absent_object_is_empty(tools: dict[str, str], tmp_path: Path) -> None:
    program(tmp_path, "kubectl", "exit 0")
    assert Kubectl("ns", tools).get("pods", "x") == {}


def test_a_timeout_reports_the_last_observed_state(tools: dict[str, str]) -> None:
    play = Play(Kubectl("ns", tools), lambda _: None)
    with pytest.raises(NotSo, match=r"not within 0 s: the robot flies\. Last seen: it rolls"):
        play.until("the robot flies", lambda: (False, "it rolls"), within=0)


def test_manifests_are_applied_with_the_images_of_another_registry(tools: dict[str, str], tmp_path: Path) -> None:
    program(tmp_path, "kubectl", f"cat >>{tmp_path}/applied")
    play = Play(Kubectl("ns", tools), lambda _: None, images="registry.example/robots")
    play.apply("robot.yaml")
    play.apply("robotworkload.yaml", edit=lambda text: _with_policy(text, "restart"))
    applied = (tmp_path / "applied").read_text()
    assert applied.count("image: registry.example/robots/understudy-quickstart:dev") == 2
    assert "localhost/" not in applied
    assert "name: quickstart-restart" in applied


def test_the_reason_why_a_pod_does_not_run_is_one_line() -> None:
    waiting = {"reason": "ImagePullBackOff", "message": "no such image"}
    pod = {"status": {"phase": "Pending", "containerStatuses": [{"state": {"waiting": waiting}}]}}
    assert _why([pod]) == "ImagePullBackOff no such image"
    assert _why([{"status": {"phase": "Pending"}}]) == "Pending"
    assert _why([]) == "not there"


def test_the_state_of_a_workload_is_reported_with_its_problems() -> None:
    conditions = [
        {"type": "Accepted", "status": "True", "message": "fine"},
        {"type": "Protected", "status": "False", "message": "no standby is ready"},
        {"type": "Recovering", "status": "False", "message": "nothing to recover"},
    ]
    workload = {"status": {"health": "Healthy", "standby": "Executing (0/1)", "conditions": conditions}}
    summary = "health Healthy, strategy None, standby Executing (0/1), Protected: no standby is ready"
    assert _state(workload) == summary


def test_unknown_strategies_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--only", "hope"])
    assert "executing" in capsys.readouterr().err


def test_the_script_documents_its_options() -> None:
    help_page = subprocess.run(
        [REPOSITORY / "scripts" / "demo", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for word in ("--keep", "--provider", "--only", "out/demo.png"):
        assert word in help_page
