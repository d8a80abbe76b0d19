"""The command: what it reads, what it prints, and how it ends."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, WORKLOAD
from understudy.cli.check.command import main

REPOSITORY = Path(__file__).resolve().parents[4]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet" / "policy.yaml").write_text(POLICY)
    (tmp_path / "fleet" / "workload.yml").write_text(WORKLOAD)
    (tmp_path / "fleet" / "notes.txt").write_text("not: [a manifest")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_folder_stands_for_its_manifests(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", "fleet/policy.yaml"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert_golden("check", captured.err, "2 objects", "2 files", "0 errors", "0 warnings")


@pytest.mark.parametrize("arguments", [["-f", "fleet"], ["-R", "."], ["-R", "-f", ".", "fleet"]])
def test_files_are_given_as_for_kubectl_too(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    assert main(arguments) == 0
    assert "2 objects checked in 2 files" in capsys.readouterr().err


def test_errors_end_with_status_1_and_warnings_only_with_strict(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fleet/workload.yml"]) == 0
    assert_golden("check", capsys.readouterr().out, "fleet/workload.yml:8:22: warning", "RobotWorkload", "robot-17")
    assert main(["--strict", "fleet/workload.yml"]) == 1
    (folder / "fleet" / "policy.yaml").write_text(POLICY.replace("gap: 500ms", "gap: 500"))
    capsys.readouterr()
    assert main(["fleet"]) == 1
    captured = capsys.readouterr()
    assert_golden(
        "check", captured.out, "fleet/policy.yaml:6:36: error", "FailurePolicy", "spec.monitoring.yaml.topic.gap", "500"
    )
    assert_golden("check", captured.err, "2 objects", "2 files", "1 error", "0 warnings")


@pytest.mark.parametrize(("form", "read"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_json_output_contains_all_findings(
    folder: Path, capsys: pytest.CaptureFixture[str], form: str, read: Callable[[str], Any]
) -> None:
    (folder / "fleet" / "policy.yaml").write_text(POLICY.replace("gap: 500ms", "gap: 500"))
    assert main(["fleet", "-o", form]) == 1
    captured = capsys.readouterr()
    (finding,) = (found := read(captured.out)).pop("findings")
    assert found == {"files": 2, "checked": 2, "passedOver": 0, "errors": 1, "warnings": 0}
    assert_golden("check", finding.pop("message"), "500")
    assert finding == {
        "file": "fleet/policy.yaml",
        "line": 6,
        "column": 36,
        "severity": "error",
        "subject": "FailurePolicy navigation",
        "field": "spec.monitoring.yaml.topic.gap",
    }
    assert captured.err.endswith("1 error, 0 warnings\n")
    assert main(["fleet/workload.yml", "-o", form]) == 0
    assert [one["severity"] for one in read(capsys.readouterr().out)["findings"]] == ["warning"]


def test_manifests_are_read_from_standard_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(POLICY.replace("Restart", "Reboot").encode())))
    assert main(["-"]) == 1
    assert_golden("check", capsys.readouterr().out, "<stdin>:8:8: error", "FailurePolicy", "spec.strategies[0].type")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.yaml"], "nowhere.yaml: No such file or directory; give a file"),
        (["."], "no *.yaml and no *.yml in this folder; add -R (--recursive) to read its subfolders"),
        (["a\0b"], "give a file"),
    ],
)
def test_unreadable_input_ends_with_status_2(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_no_file_ends_with_status_2() -> None:
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2


def test_check_runs_as_a_subcommand_without_ros() -> None:
    program = (
        "import sys; sys.modules['rclpy'] = None; sys.argv = ['understudy', 'check', 'examples/quickstart/manifests/strategies'];"
        "from understudy.main import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY,
        env={"PYTHONPATH": "operator", "LC_ALL": "C"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "7 objects checked in 4 files" in done.stderr
