"""``understudy report``: what it asks kubectl, what it writes, and how it ends."""

from __future__ import annotations

import csv
import re
import shlex
from pathlib import Path

import pytest

from tests.support import fleet as others
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden, assert_shown
from tests.unit.cli.report import fleet
from understudy.cli.report.command import main

DOCUMENTATION = Path(__file__).parents[4] / "docs" / "report.md"

pytestmark = pytest.mark.usefixtures("in_the_present")


@pytest.fixture
def written(stand: FakeKubectl, tmp_path: Path) -> Path:
    """Where the page goes."""
    stand.tell(fleet.robots())
    return tmp_path / "report.html"


def test_the_command_writes_a_page_and_csv_files(
    stand: FakeKubectl, written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["-n", "fleet", "-o", str(written), "--csv", str(written.parent / "data")]) == 0
    output = capsys.readouterr().out.removeprefix(f"{written}: ")
    assert_golden(
        "report", output, "5 robots", "18 recoveries", "2026-11-21 14:06:24Z", "2026-11-22 14:06:24Z", "1 robot"
    )
    robots, *pods = stand.asked
    assert robots.startswith("--namespace=fleet get robotworkloads.understudy.dev -o json")
    assert all(asked.startswith("--namespace=fleet get pods -l understudy.dev/") for asked in pods)
    assert written.read_text().startswith("<!doctype html>\n")
    assert sorted(path.name for path in (written.parent / "data").iterdir()) == [
        *("recoveries.csv", "reserved.csv", "robots.csv", "strategies.csv")
    ]
    with (written.parent / "data" / "recoveries.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 18


def test_the_documentation_shows_the_printed_output(
    stand: FakeKubectl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    stand.tell(fleet.robots())
    ((arguments, expected),) = re.findall(r"\$ understudy report (.*?)\n(.*?)```", DOCUMENTATION.read_text(), re.DOTALL)
    assert main(shlex.split(arguments)) == 0
    assert_shown(DOCUMENTATION, expected, capsys.readouterr().out)
    assert (tmp_path / "understudy-report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        (["--since", "90m"], 4),
        (["--from", "2026-11-22T13:00:00Z"], 4),
        (["--from", "2026-11-22T13:00:00+00:00", "--to", "2026-11-22T13:30:00"], 3),
        (["--from", "2026-11-22", "--to", "2027-01-01"], 18),
        (["--since", "1h", "--to", "2026-11-22T05:00:00Z"], 1),
    ],
)
def test_the_period_can_be_selected(
    written: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], count: int
) -> None:
    assert main([*arguments, "-o", str(written)]) == 0
    assert f"5 robots, {count} recover" in capsys.readouterr().out


def test_the_report_can_cover_one_robot(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-3-drive", "-o", str(written)]) == 0
    assert "<h1>Recoveries of robot-3-drive</h1>" in written.read_text()


def test_the_report_can_cover_every_namespace(stand: FakeKubectl, written: Path) -> None:
    assert main(["-A", "-o", str(written)]) == 0
    assert " -A -o json" in stand.asked[0]
    assert "<h1>Recoveries of all namespaces</h1>" in written.read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-n", "flet"], "namespace flet does not exist"),
        (["-n", "lab"], "there is no RobotWorkload in this namespace"),
        ([], "there is no RobotWorkload in this namespace"),
        (["-A"], "there is no RobotWorkload in the cluster"),
        (["robot-2"], 'robotworkloads.understudy.dev "robot-2" not found'),
        (["--since", "a while"], "--since: 'a while' is not a duration"),
        (["--since", "99999999h"], "--since: year -9382 is out of range"),
        (["--since", "99999999999999h"], "--since: "),
        (["--from", "yesterday"], "--from: found 'yesterday'; give a date or a time"),
        (["--from", "2027-01-01"], "the period would begin at 2027-01-01 00:00:00Z and end at 2026-11-22 14:06:24Z"),
    ],
)
def test_unavailable_information_is_reported(
    stand: FakeKubectl,
    written: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    stand.tell([others.spare(), {"kind": "Namespace", "metadata": {"name": "lab"}}])
    assert main([*arguments, "-o", str(written)]) == 2
    captured = capsys.readouterr()
    assert (captured.out, written.exists()) == ("", False)
    assert captured.err.startswith("understudy report: ")
    assert words in captured.err


def test_an_unwritable_path_is_reported(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written.mkdir()
    assert main(["-o", str(written)]) == 2
    assert_golden("report", capsys.readouterr().err.replace(str(written), "report.html"), "Is a directory")
