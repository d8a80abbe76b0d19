"""The CSV files hold what was found, and nothing that a spreadsheet would run."""

from __future__ import annotations

import csv
import io
import json

import pytest

from tests.unit.cli.report import fleet
from tests.unit.cli.report.fleet import DAY
from understudy.api.plain_text import plain
from understudy.cli.report.csv_sheets import sheets
from understudy.cli.report.recovery_records import findings


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text, newline="")))


def test_the_csv_files_contain_the_values_of_the_records() -> None:
    found = findings(fleet.robots(), DAY)
    read = rows(sheets(found)["recoveries.csv"])
    assert len(read) == len(found.entries) == 18
    for row, entry in zip(read, found.entries, strict=True):
        recovery = entry.recovery
        assert (row["robot"], int(row["number"]), row["id"]) == (entry.name, recovery.number, recovery.id)
        assert row["recovery_seconds"] == ("" if recovery.recovery_seconds is None else repr(recovery.recovery_seconds))
        assert recovery.parts is not None
        assert float(row["cluster_seconds"]) == recovery.parts.cluster
        assert json.loads(row["attempts"]) == [attempt.to_wire() for attempt in recovery.attempts]
        assert row["verified"] == (recovery.moments.verified or "")
        if not recovery.reason.startswith("="):
            assert row["reason"] == recovery.reason


def test_the_csv_files_list_robots_and_strategies() -> None:
    found = findings(fleet.robots(), DAY)
    data = sheets(found)
    robots = {row["robot"]: row for row in rows(data["robots.csv"])}
    assert (robots["robot-2-drive"]["recoveries_ever"], robots["robot-2-drive"]["recoveries_kept"]) == ("12", "10")
    assert robots["robot-3-drive"]["protected"] == "false"
    assert float(robots["robot-3-drive"]["down_seconds"]) == pytest.approx(found.robot_periods[2].down, abs=1e-6)
    restart = next(row for row in rows(data["strategies.csv"]) if row["strategy"] == "Restart")
    assert (restart["count"], float(restart["p50_seconds"])) == ("2", 3.682)


def test_no_text_is_interpreted_as_a_formula() -> None:
    data = sheets(findings([fleet.hostile()], DAY))
    assert rows(data["recoveries.csv"])[0]["reason"] == f"'{plain(fleet.HOSTILE)}"
    for text in data.values():
        assert not any(cell.startswith(("=", "+", "-", "@")) for row in csv.reader(io.StringIO(text)) for cell in row)
