"""docs/choosing.md says what the rules and the figures are."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

from understudy.advice.order_explanation import strategy_name
from understudy.advice.strategy_figures import PUBLISHED_CPU, PUBLISHED_SECONDS, Figures
from understudy.advice.strategy_order import NEGLIGIBLE, SOON, Candidate, order_strategies
from understudy.api.kinds.requirements_spec import Level, Requirements
from understudy.trees.core.leaf import duration

PAGE = (Path(__file__).parents[4] / "docs" / "choosing.md").read_text()
POOLS = [Candidate("Executing", "", 1), Candidate("Initialized", "", 1), Candidate("Uninitialized", "", 2)]


def rows(heading: str) -> list[list[str]]:
    """The rows of the first table behind a text, but for its head."""
    table = re.search(r"(^\|.*\|\n)+", PAGE[PAGE.index(heading) :], re.MULTILINE)
    assert table
    lines = table[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_page_has_the_figures_of_the_code() -> None:
    found = rows("## The figures")
    assert len(found) == len(PUBLISHED_SECONDS)
    for name, seconds, cpu in found:
        way = name.strip("`")
        assert seconds == duration(PUBLISHED_SECONDS[way])  # type: ignore[index]
        assert cpu == (f"{PUBLISHED_CPU[way] * 100:g} %" if way != "Restart" else "")  # type: ignore[index]


def test_the_page_has_the_orders_that_the_requirements_produce() -> None:
    table = rows("With one pool of each readiness and the published figures")
    assert len(table) == len(get_args(Level))
    for usage, *usages in table:
        before = ""
        for availability, cell in zip(get_args(Level), usages, strict=True):
            asked = Requirements.model_validate({"resourceUsage": usage.strip("`"), "availability": availability})
            found = order_strategies(asked, POOLS, Figures())
            words, _, missed = cell.partition(", and it isn't met")
            order = ", ".join(strategy_name(one.candidate) for one in found.chosen)
            assert order == (before if words.startswith("the same") else words)
            assert cell.endswith("isn't met") == (not found.is_fast_enough), missed
            before = order


def test_the_page_has_the_levels_and_defaults_of_the_code() -> None:
    assert (SOON["Medium"], SOON["High"], NEGLIGIBLE) == (2.0, 0.5, 0.1)
    levels = {row[0].split("`")[1]: row for row in rows("## What can be required")}
    assert levels["availability"][2:4] == [duration(SOON["Medium"]), duration(SOON["High"])]
    defaults = Requirements().to_wire()
    assert {name: row[4].strip("`") for name, row in levels.items()} == defaults
