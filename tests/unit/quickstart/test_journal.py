from __future__ import annotations

import json
from pathlib import Path

import pytest
from understudy_demo.robotview import parse
from understudy_quickstart.journal import Journal


def fill(journal: Journal, count: int, *, start: int = 0) -> None:
    for number in range(start, start + count):
        journal.write(
            "command",
            received=number / 20,
            sequence=number,
            source="pod",
            sent=number / 20,
            linear=0.5,
            angular=0.0,
            x=0.0,
            y=0.0,
            heading=0.0,
            speed=0.5,
        )


def test_records_go_to_the_file_and_to_standard_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / "robot.jsonl"
    fill(Journal(str(file)), 3)
    assert [json.loads(line)["sequence"] for line in file.read_text().splitlines()] == [0, 1, 2]
    assert file.read_text() == capsys.readouterr().out
    assert len(parse(file.read_text()).commands) == 3


def test_without_a_file_records_are_only_printed(capsys: pytest.CaptureFixture[str]) -> None:
    fill(Journal(None), 2)
    assert len(parse(capsys.readouterr().out).commands) == 2


def test_the_file_is_bounded_and_appended_after_a_restart(tmp_path: Path) -> None:
    file = tmp_path / "robot.jsonl"
    journal = Journal(str(file), limit=4000)
    fill(journal, 100)
    older = tmp_path / "robot.jsonl.1"
    assert file.stat().st_size <= 4200
    assert older.stat().st_size <= 4200
    kept = [c.sequence for c in parse(older.read_text() + file.read_text()).commands]
    assert kept == list(range(kept[0], 100)), "nothing between the two files is lost"
    fill(Journal(str(file), limit=1_000_000), 1, start=100)
    assert parse(file.read_text()).commands[-1].sequence == 100, "a restarted robot appends"


def test_a_full_disk_ends_the_file_but_not_the_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = Journal("/dev/full")
    fill(journal, 3)
    printed = capsys.readouterr().out
    assert len(parse(printed).commands) == 3
    assert printed.count('"event": "journal"') == 1
    assert "/dev/full" in printed
