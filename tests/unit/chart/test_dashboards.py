"""Dashboards without a Grafana: their panels have room, their variables are used, and they count every recovery.

``scripts/dashboards`` draws them.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from typing import Any, get_args

import pytest

from scripts.generation.metrics import exposed, page
from tests.dashboards.fleet import fleet
from tests.e2e.past import Source
from tests.unit.chart.alert_rules import OTHERS, alerts
from tests.unit.chart.conftest import CHART
from understudy.api.kinds.robot_workload import Health

BOARDS = {path.stem: json.loads(path.read_text()) for path in (CHART / "files" / "dashboards").glob("*.json")}
PANELS = [pytest.param(panel, id=f"{name}: {panel['title']}") for name, b in BOARDS.items() for panel in b["panels"]]
GRAFANAS = {"__range", "__range_s", "__interval", "__rate_interval", "__all", "__data"}
COUNTED = r"understudy_(?:recoveries_total|recovery_(?:part_)?seconds_(?:sum|count)|claim_seconds_bucket|gate_commit_seconds_bucket)"
"""Counters of monitors that begin with the first of what they count."""

Object = dict[str, Any]


def targets() -> Iterator[Object]:
    """All that is asked for."""
    for board in BOARDS.values():
        for panel in board["panels"]:
            yield from panel["targets"]


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_panels_have_unique_ids_and_fill_the_grid_without_overlap(board: Object) -> None:
    panels = board["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken: dict[tuple[int, int], str] = {}
    for panel in panels:
        at = panel["gridPos"]
        assert at["x"] + at["w"] <= 24, panel["title"]
        for cell in itertools.product(range(at["x"], at["x"] + at["w"]), range(at["y"], at["y"] + at["h"])):
            assert taken.setdefault(cell, panel["title"]) == panel["title"]
    below = max(y for _, y in taken) + 1
    assert len(taken) == 24 * below, "no holes"


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_every_variable_is_used_and_every_used_variable_is_defined(board: Object) -> None:
    there = {variable["name"] for variable in board["templating"]["list"]}
    texts = [json.dumps(board["panels"]), *(json.dumps(variable) for variable in board["templating"]["list"])]
    used = {name for text in texts for name in re.findall(r"\$\{?(\w+)", text)}
    assert used - GRAFANAS == there


@pytest.mark.parametrize("panel", PANELS)
def test_each_panel_has_a_unit_and_a_data_source(panel: Object) -> None:
    assert panel["type"] in ("timeseries", "stat", "table", "state-timeline")
    assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
    assert panel["type"] == "state-timeline" or panel["fieldConfig"]["defaults"]["unit"]
    assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])


@pytest.mark.parametrize("panel", PANELS)
def test_stats_and_tables_use_instant_queries(panel: Object) -> None:
    now = panel["type"] in ("stat", "table")
    assert {bool(target.get("instant")) for target in panel["targets"]} == {now}
    assert {target.get("format") == "table" for target in panel["targets"]} == {panel["type"] == "table"}


@pytest.mark.parametrize("panel", PANELS)
def test_an_override_refers_to_an_existing_series_or_column(panel: Object) -> None:
    columns = {n for t in panel.get("transformations", ()) for n in t["options"].get("renameByName", {}).values()}
    names = columns | {target["legendFormat"] for target in panel["targets"]}
    if "{{health}}" in names:
        names |= set(get_args(Health))
    for result in ("Failed", "Recovered"):
        names |= {name.replace("{{result}}", result) for name in names}
    assert {override["matcher"]["options"] for override in panel["fieldConfig"]["overrides"]} <= names


@pytest.mark.parametrize("panel", [p for p in PANELS if p.values[0]["type"] == "table"])  # type: ignore[index]
def test_the_columns_of_a_table_come_from_its_queries(panel: Object) -> None:
    (organize,) = (t["options"] for t in panel["transformations"] if t["id"] == "organize")
    grouped = {label for target in panel["targets"] for label in _grouped(target["expr"])}
    several = len(panel["targets"]) > 1
    values = {f"Value #{target['refId']}" if several else "Value" for target in panel["targets"]}
    assert organize["renameByName"].keys() | organize["excludeByName"].keys() == grouped | values | {"Time"}
    assert several == any(t["id"] == "merge" for t in panel["transformations"])


def test_a_legend_uses_existing_labels() -> None:
    labels = {
        name: set(re.findall(r"`(\w+)`", label_text))
        for name, label_text in re.findall(r"(?m)^\| `(\w+)` \| \w+ \| (.*?) \|", page())
    }
    for target in targets():
        (first, *_) = re.findall(r"understudy_\w+|process_\w+", target["expr"])
        there = _grouped(target["expr"]) or labels.get(first, set())
        assert set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])) <= there, target["expr"]


def test_every_state_has_the_same_colour_in_all_panels() -> None:
    by_health, timeline = (_titled(title) for title in ("Robots by health", "Health and conditions"))
    colours = {
        override["matcher"]["options"]: override["properties"][0]["value"]["fixedColor"]
        for override in by_health["fieldConfig"]["overrides"]
    }
    assert set(colours) == set(get_args(Health))
    (mapped,) = timeline["fieldConfig"]["defaults"]["mappings"]
    numbers = dict(re.findall(r'(\d+) \* sum\(\w+\{health="(\w+)"', timeline["targets"][0]["expr"]))
    assert {
        numbers[number]: option["color"] for number, option in mapped["options"].items() if number in numbers
    } == colours
    assert all(numbers[number] == option["text"] for number, option in mapped["options"].items() if number in numbers)


def test_a_gate_in_an_unknown_state_is_not_shown_as_open() -> None:
    (alert,) = (alert for alert in alerts() if alert["alert"] == "UnderstudyGateNotEnforced")
    (left_out,) = re.findall(r'reason!~"[^"]+"', alert["expr"])
    asked = [target["expr"] for target in targets() if 'condition="GateEnforced"' in target["expr"]]
    assert asked
    assert all(left_out in expression for expression in asked)


def _increase(metric: str, where: str, ago: str, begin: str) -> str:
    """Return the increase of the monitors' counters in a period, by series.

    ``increase`` alone would be wrong. A series of a strategy begins with the first recovery by it after each start of a
    monitor, so ``increase`` does not count that recovery, and most robots have few. It also extrapolates to the ends of
    the period, so that counts would not be whole numbers.

    In this order: ``increase`` for a counter that was reset in its pod; the difference for a series that existed at the start of the
    period; the value for a new series whose monitor was scraped already or did not exist yet; and the difference to the first
    sample for a monitor that is older than its data.
    """
    series = f"{metric}{where}"
    started = f"last_over_time(process_start_time_seconds{where}[{ago}])"
    fresh = f"(understudy_tree_evaluations_total{where} offset {ago} or {started} >= {begin})"
    return (
        f"(increase({series}[{ago}]) and resets({series}[{ago}]) > 0)"
        f" or (last_over_time({series}[{ago}]) - {series} offset {ago})"
        f" or (last_over_time({series}[{ago}]) and on (job, instance) {fresh})"
        f" or (last_over_time({series}[{ago}]) - min_over_time({series}[{ago}]))"
    )


def test_panels_count_the_first_recovery_after_a_monitor_start() -> None:
    counting = [target["expr"] for target in targets() if re.search(COUNTED, target["expr"])]
    assert len(counting) > 10
    for expression in counting:
        whole = expression
        for metric, where in set(re.findall(rf"\b({COUNTED})(\{{[^}}]*\}})", expression)):
            for ago, begin in (("$__range", "time() - $__range_s"), ("1h", "time() - 3600")):
                whole = whole.replace(_alive_of_all(_increase(metric, where, ago, begin)), "")
        assert not re.search(COUNTED, whole), whole


def _alive_of_all(expression: str) -> str:
    """A monitor lives whatever the strategy, part and result that are asked for."""
    return re.sub(
        r"((?:understudy_tree_evaluations_total|process_start_time_seconds)\{[^}]*?),(?:result|part)!?=\"\w+\"",
        r"\1",
        expression,
    )


def test_the_fleet_of_the_dashboard_tests_exports_every_queried_metric() -> None:
    end = 1e9
    operator = fleet(end)
    sources: list[Source] = [*operator.robots, operator]
    samples = {line.partition("{")[0] for source in sources for line in source.told(end)}
    assert samples <= exposed() | OTHERS
    assert {name for t in targets() for name in re.findall(r"\b(?:understudy|process)_[a-z_]+", t["expr"])} <= samples


def _titled(title: str) -> Object:
    (found,) = (panel for board in BOARDS.values() for panel in board["panels"] if panel["title"] == title)
    return dict(found)


def _grouped(expression: str) -> set[str]:
    return {label for labels in re.findall(r"\bby \(([^)]*)\)", expression) for label in labels.split(", ")}
