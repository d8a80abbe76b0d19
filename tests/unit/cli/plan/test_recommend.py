"""``understudy recommend``: what it prints, what counts as measured, and what it says to what it can't answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.golden import assert_golden
from tests.unit.controller import strategy_policies as chosen
from understudy.cli.common.errors import ERROR
from understudy.cli.plan.recommend import MET, NOT_MET, main

WORKLOAD = """\
apiVersion: understudy.dev/v1alpha1
kind: RobotWorkload
metadata: {name: robot-17, namespace: fleet, labels: {app: navigation}}
spec:
  workloadRef: {kind: Deployment, name: nav2}
  outputs:
    - {topic: /cmd_vel, type: geometry_msgs/msg/TwistStamped}
  failurePolicyRef: {name: navigation}
"""
POLICY = """\
apiVersion: understudy.dev/v1alpha1
kind: FailurePolicy
metadata: {name: navigation, namespace: fleet}
spec:
  monitoring:
    yaml: {topic: {name: /cmd_vel, gap: 500ms}}
  requirements: {availability: Medium}
  strategies:
    - {type: Auto}
"""
POOLS = """\
apiVersion: understudy.dev/v1alpha1
kind: FallbackPool
metadata: {name: hot, namespace: fleet}
spec:
  readiness: Executing
  perWorkload: 1
  workloadSelector: {matchLabels: {app: navigation}}
---
apiVersion: understudy.dev/v1alpha1
kind: FallbackPool
metadata: {name: warm, namespace: fleet}
spec:
  readiness: Initialized
  perWorkload: 1
  workloadSelector: {matchLabels: {app: navigation}}
  initialization:
    yaml: {set_lifecycle: {node: /amcl, state: active}}
---
apiVersion: understudy.dev/v1alpha1
kind: FallbackPool
metadata: {name: spare, namespace: fleet}
spec:
  readiness: Uninitialized
  replicas: 2
  workloadSelector: {matchLabels: {app: navigation}}
  templateFrom: {workload: robot-17}
"""
ALL = (WORKLOAD, POLICY, POOLS)

Run = Callable[..., Any]


def recovery(by: str, seconds: float) -> dict[str, Any]:
    parts = {"detection": 0.5, "cluster": seconds, "startup": 0.0, "reinitialization": 0.0}
    return {"id": f"{by}-{seconds}", "reason": "gone", "result": "Recovered", "strategy": by, "parts": parts}


RECORDED = {"recoveries": [recovery("Restart", seconds) for seconds in (1.1, 1.2, 1.3)]}


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Writes manifests into one file, on a machine that knows of no cluster."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("KUBECONFIG", raising=False)

    def write(*texts: str) -> str:
        path = tmp_path / "robot.yaml"
        path.write_text("---\n".join(texts or ALL))
        return str(path)

    return write


@pytest.fixture
def cluster(file: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Returns a function that installs a script as kubectl; the function returns the file of the requests that the script received."""

    def tell(script: str) -> Path:
        asked = tmp_path / "asked"
        kubectl = tmp_path / "kubectl"
        kubectl.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n{script}\n')
        kubectl.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
        monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
        return asked

    return tell


def answered(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = MET) -> list[dict[str, Any]]:
    assert main([*arguments, "-o", "json"]) == status
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def test_yaml_output_equals_json_output(file: Callable[..., str], capsys: pytest.CaptureFixture[str]) -> None:
    found = answered(capsys, file())
    assert main([file(), "-o", "yaml"]) == MET
    assert yaml.safe_load(capsys.readouterr().out) == found


def order(found: dict[str, Any]) -> list[str]:
    return [one["pool"] or one["strategy"] for one in found["order"]]


def test_the_trade_off_table_gives_the_reason_for_each_rank(file, capsys):
    assert main([file()]) == MET
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "fleet/robot-17, FailurePolicy navigation"
    assert_golden("plan", lines[1], "within 2 s", "availability Medium")
    table = [" ".join(line.split()) for line in lines[3:8]]
    assert_golden(
        "plan",
        table,
        "1. Initialized (warm)",
        "2. Uninitialized (spare)",
        "3. Restart",
        "- Executing (hot)",
        "830 ms",
        "68 %",
        "3.96 s",
        "0 %",
        "4.67 s",
        "50 ms",
        "96 %",
        "96%",
        "10%",
    )
    assert_golden("plan", "\n".join(lines), "docs/choosing.md")


def test_json_output_contains_all_figures(file, capsys):
    (found,) = answered(capsys, file())
    assert (found["workload"], found["namespace"], found["policy"], found["auto"]) == (
        "robot-17",
        "fleet",
        "navigation",
        True,
    )
    assert found["requirements"] == {
        "safety": "Low",
        "availability": "Medium",
        "resourceUsage": "Medium",
        "taskCriticality": "Low",
    }
    assert order(found) == ["warm", "spare", "Restart"]
    (hot,) = found["leftOut"]
    assert (hot["strategy"], hot["pool"], hot["seconds"]) == (
        "Fallback/Executing",
        "hot",
        {"value": 0.05, "source": "published"},
    )
    assert found["notMet"] == []


def test_options_replace_the_requirements(file, capsys):
    (found,) = answered(capsys, file(), "--task-criticality", "High", "--availability", "Low")
    assert order(found) == ["hot", "warm", "spare", "Restart"]
    (found,) = answered(capsys, file(), "--resource-usage", "Low", "--availability", "Low")
    assert order(found) == ["spare", "Restart"]


def test_unmet_requirements_are_reported_and_set_the_exit_status(file, capsys):
    assert main([file(), "--availability", "High", "--resource-usage", "Low"]) == NOT_MET
    output = capsys.readouterr().out
    assert_golden("plan", output, "availability High", "500 ms", "Uninitialized (spare)")


def test_the_measured_usage_of_a_standby_is_used(file, capsys):
    (found,) = answered(capsys, file(), "--cpu", "Executing=0.3", "--cpu", "Uninitialized=0.6")
    assert order(found)[0] == "hot"
    assert found["order"][0]["cpu"] == {"value": pytest.approx(0.3), "standbys": 1.0, "source": "given"}
    assert "spare" not in order(found), "it takes 0.6 for each of two, and nobody shares them"


def test_a_shared_pool_costs_each_robot_its_share(file, capsys):
    robots = "---\n".join(WORKLOAD.replace("robot-17", f"robot-{number}") for number in range(17, 41))
    found = answered(capsys, file(robots, POLICY, POOLS), "--cpu", "Uninitialized=0.6")
    assert len(found) == 24
    spare = found[0]["order"][1]
    assert (spare["pool"], spare["cpu"]["value"]) == ("spare", pytest.approx(0.6 * 2 / 24))


def test_recoveries_in_kubectl_output_are_used_as_measurements(file, capsys):
    items = [item | {"status": RECORDED} if item["kind"] == "RobotWorkload" else item for item in _items()]
    (found,) = answered(capsys, file(yaml.safe_dump({"apiVersion": "v1", "kind": "List", "items": items})))
    assert order(found) == ["Restart", "spare"]
    assert found["order"][0]["seconds"] == {"value": 1.2, "source": "measured 3 times"}


def test_recoveries_in_the_cluster_are_used_as_measurements(file, cluster, capsys):
    items = [item | {"status": RECORDED} for item in _items() if item["kind"] == "RobotWorkload"]
    asked = cluster(f"cat <<'E'\n{json.dumps({'items': items})}\nE")
    (found,) = answered(capsys, file())
    assert order(found) == ["Restart", "spare"]
    assert asked.read_text().startswith("--namespace=fleet get robotworkloads -o json")
    (found,) = answered(capsys, file(), "--no-cluster")
    assert order(found)[0] == "warm"


def test_an_unavailable_cluster_is_reported_and_fatal_only_if_requested(file, cluster, capsys):
    cluster("echo 'connection refused' >&2; exit 1")
    assert main([file()]) == MET
    captured = capsys.readouterr()
    assert_golden("plan", captured.err, "connection refused")
    assert "830 ms  published" in captured.out
    assert main([file(), "--context", "fleet"]) == ERROR
    assert "understudy recommend: connection refused" in capsys.readouterr().err


def test_explicit_strategies_are_printed_next_to_the_recommended_ones(file, capsys):
    written = POLICY.replace("{type: Auto}", "{type: Fallback, poolRef: {name: hot}}\n    - {type: Restart}")
    written = written.replace("  requirements: {availability: Medium}\n", "")
    assert main([file(WORKLOAD, written, POOLS)]) == MET
    assert_golden("plan", capsys.readouterr().out, "Executing, Restart")


@pytest.mark.parametrize("levels", [{}, {"availability": "Low"}, {"taskCriticality": "High"}, {"safety": "Medium"}])
def test_the_operator_chooses_the_recommended_strategies(file, capsys, levels):
    status = {"recoveries": [recovery("Fallback/Initialized", seconds) for seconds in (0.4, 0.5, 2.5)]}
    made = chosen.world(chosen.auto(**levels), status=status)
    (found,) = answered(capsys, file(yaml.safe_dump_all([made.workload, *made.others])))
    assert order(found) == chosen.order(made.plan())


@pytest.mark.parametrize("form", ["png", "svg"])
def test_the_plot_is_drawn(file, capsys, tmp_path, form):
    pytest.importorskip("matplotlib")
    picture = tmp_path / f"tradeoff.{form}"
    assert main([file(), "--plot", str(picture)]) == MET
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("texts", "more", "expected"),
    [
        ((POLICY, POOLS.replace("robot-17", "robot-1")), [], "there is no RobotWorkload in the files"),
        (
            (WORKLOAD, POOLS),
            [],
            "RobotWorkload robot-17: its FailurePolicy navigation is not in the files; give its file too",
        ),
        (
            ALL,
            ["--workload", "robot-71"],
            "--workload: there is no RobotWorkload 'robot-71' in the files (did you mean",
        ),
        ((WORKLOAD, POLICY.replace("Medium", "Middle"), POOLS), [], "the manifests are invalid\n"),
        ((WORKLOAD, "spec: {a: [}\n"), [], "the files cannot be read\n"),
        (ALL, ["--plot", "tradeoff.txt"], "--plot: found 'tradeoff.txt'; its name must end in .png"),
        (
            (WORKLOAD, WORKLOAD.replace("robot-17", "robot-18"), POLICY, POOLS),
            ["--plot", "x.png"],
            "--plot draws one workload, but the files contain robot-17, robot-18: choose one with --workload",
        ),
    ],
)
def test_impossible_requests_are_reported_with_a_solution(file, capsys, texts, more, expected):
    assert main([file(*texts), *more]) == ERROR
    error = capsys.readouterr().err
    assert error.startswith("understudy recommend: ")
    assert expected in error


@pytest.mark.parametrize(
    "value", ["Initialised=0.4", "Initialized", "Executing=-1", "Restart=1", "Executing=nan", "Executing=%"]
)
def test_an_invalid_cpu_share_is_refused_by_name(file, capsys, value):
    with pytest.raises(SystemExit) as ended:
        main([file(), "--cpu", value])
    assert ended.value.code == 2
    message = f"--cpu: found '{value}'; give one of Uninitialized, Initialized, Executing with a share, such as Initialized=0.4"
    assert message in capsys.readouterr().err


def _items() -> list[dict[str, Any]]:
    return [item for text in ALL for item in yaml.safe_load_all(text)]
