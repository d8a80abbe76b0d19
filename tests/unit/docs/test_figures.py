"""Figures in sentences and in tables are those of the result files, and each page names these files and their commits."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from scripts.generation import figures, tables
from scripts.generation.figures import SOURCES_BEGIN, SOURCES_END

END = f"{SOURCES_BEGIN}\n{SOURCES_END}\n"


def figure(unit: str, *values: float) -> dict[str, Any]:
    ordered = sorted(values)
    mean = sum(values) / len(values)
    return {"unit": unit, "values": values, "n": len(values), "p50": ordered[0], "max": ordered[-1], "mean": mean}


def write(folder: Path, name: str, commit: str = "0123456789ab", **found: dict[str, Any]) -> None:
    result = {"date": "2026-12-01T10:00:00+00:00", "commit": commit, "figures": found}
    (folder / f"{name}.json").write_text(json.dumps(result))


def sentence(text: str, results: Path) -> str:
    """Return a sentence with its figures written again."""
    return figures.in_sentences(f"{text}\n{END}", results).partition("\n")[0]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    write(
        tmp_path,
        "drive",
        **{"a: gap": figure("ms", 1204.4, 1751.6, 2000), "b: gap": figure("ms", 826, 826), "b: early": figure("", 0)},
    )
    return tmp_path


@pytest.mark.parametrize(
    ("text", "becomes"),
    [
        ("took 9.9<!-- figure: drive; a: gap; max in s --> s", "2.0"),
        ("took 1<!-- figure: drive; a: gap; p50 --> ms", "1204"),
        ("took 1.0 / 1.00<!-- figure: drive; a: gap; p50 max in s --> s", "1.2 / 2.00"),
        ("in 3<!-- figure: drive; b: gap; n --> failures", "2"),
        ("and 7.5<!-- figure: drive; b: early; max --> commands", "0"),
        ("costs 1<!-- figure: drive; a: gap; % above b: gap --> % more", "100"),
        ("in all 1<!-- figure: drive; a: gap; sum --> ms", "4956"),
    ],
)
def test_a_figure_in_a_sentence_becomes_that_of_its_file_with_the_decimals_it_had(
    results: Path, text: str, becomes: str
) -> None:
    before, marker, after = text.partition("<!--")
    words = before[: before.index(next(character for character in before if character.isdigit()))]
    assert sentence(text, results) == f"{words}{becomes}{marker}{after}"


def test_writing_again_changes_nothing(results: Path) -> None:
    page = figures.in_sentences(f"took 1.0<!-- figure: drive; a: gap; p50 in s --> s\n{END}", results)
    assert figures.in_sentences(page, results) == page


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1<!-- figure: drive; c: gap; p50 -->", "'c: gap' is not in drive.json"),
        ("1<!-- figure: nothing; a: gap; p50 -->", "'a: gap' is not in nothing.json"),
        ("1<!-- figure: drive; a: gap; p99 -->", "'p99' is not in drive.json"),
        ("1<!-- figure: drive; a: gap; p50 max -->", "2 numbers"),
        ("about<!-- figure: drive; a: gap; p50 -->", "write NUMBER<!-- figure:"),
        ("1<!-- figure: drive; a: gap -->", "write NUMBER<!-- figure:"),
    ],
)
def test_a_figure_that_no_file_has_is_an_error(results: Path, text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=re.escape(problem)):
        sentence(text, results)


def test_a_page_with_figures_names_their_files(results: Path) -> None:
    text = "1<!-- figure: drive; a: gap; p50 -->"
    with pytest.raises(ValueError, match="result files"):
        figures.in_sentences(text, results)
    page = figures.in_sentences(f"{text}\n{END}", results)
    assert "From `bench/results`: `drive.json` (2026-12-01, commit 01234567)." in page


def test_files_of_different_commits_are_called_that(results: Path) -> None:
    write(results, "same")
    write(results, "other", commit="ba9876543210-dirty")
    assert "different" not in figures.sources(results, ["drive", "same"])
    told = figures.sources(results, ["other", "drive"])
    assert "commit ba987654-dirty" in told
    assert told.endswith("These files are of different commits.")


def test_a_table_has_a_column_for_each_configuration_of_each_stack_that_was_measured(tmp_path: Path) -> None:
    write(
        tmp_path,
        "navigation",
        **{"pod-started: t_recovery": figure("ms", 4000), "executing: t_recovery": figure("ms", 150)},
    )
    head, _, row, *rest = tables.navigation(tmp_path).splitlines()
    assert head == "| | pod started | full navigation |"
    assert row == "| t_recovery | 4.00 | 0.15 |"
    assert rest == ["", "From `bench/results`: `navigation.json` (2026-12-01, commit 01234567)."]

    write(
        tmp_path,
        "nav2",
        commit="fedcba987654",
        **{"restart: t_recovery": figure("ms", 9000), "restart: t_startup": figure("ms", 0)},
    )
    head, _, *rows, _, told = tables.navigation(tmp_path).splitlines()
    assert head == "| | pod started | full navigation | Nav2: restart |"
    assert rows == ["| t_startup |  |  | 0 |", "| t_recovery | 4.00 | 0.15 | 9.00 |"]
    assert told.endswith("These files are of different commits.")


def test_a_table_is_written_between_its_markers(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "TABLES", {"one": lambda results: "| new |"})
    begin, end = "<!-- table one: written by scripts/generate from bench/results -->", "<!-- end of table one -->"
    page = tables.in_page(f"before\n{begin}\n| old |\n{end}\nafter\n", results)
    assert page == f"before\n{begin}\n| new |\n{end}\nafter\n"
    with pytest.raises(ValueError, match="no table two"):
        tables.in_page(page.replace("table one", "table two"), results)
    with pytest.raises(ValueError, match="between"):
        tables.in_page(page.replace(end, ""), results)


def test_every_table_stands_in_a_page() -> None:
    root = Path(__file__).resolve().parents[3]
    text = "".join((root / page).read_text() for page in figures.pages(root))
    assert [name for name in tables.TABLES if f"<!-- table {name}:" not in text] == []
