"""The page says what the records say, asks for nothing, and runs nothing of what others have written."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from tests.support.golden import assert_golden
from tests.support.html_pages import Read, value
from tests.unit.cli.report import fleet
from tests.unit.cli.report.fleet import DAY, NOW
from understudy.cli.report.csv_sheets import sheets
from understudy.cli.report.page import page
from understudy.cli.report.recovery_records import Findings, Span, findings
from understudy.cli.report.sections import availability


def written(found: Findings) -> str:
    return page(found, sheets(found), where="namespace fleet", made=NOW)


def read(*robots: fleet.Object, period: Span = DAY) -> Read:
    return Read(written(findings(robots, period)))


def test_the_figures_agree_with_the_records() -> None:
    found = findings(fleet.robots(), DAY)
    shown = Read(written(found))
    rows = shown.table("Recoveries that began")
    assert len(rows) == len(found.entries)
    for row, entry in zip(rows, found.entries, strict=True):
        assert (row[0][0], value(row[1]), value(row[2])) == (entry.name, entry.recovery.number, entry.began)
        if entry.recovered:
            assert value(row[5]) == entry.recovery.recovery_seconds
        assert row[-1][0] == entry.recovery.reason.replace("\u202e", "\\u202e")
    for row, group in zip(shown.table("Recovery time by strategy"), found.groups, strict=True):
        assert (row[0][0], value(row[1])) == (group.name, len(group.entries))
        assert [value(cell) for cell in row[2:6]] == list(group.parts.values())
        assert [value(cell) for cell in row[7:9]] == [group.spread.p50, group.spread.p95]
    for row, robot_period in zip(shown.table("Robots:"), found.robot_periods, strict=True):
        assert (row[0][0], value(row[7])) == (robot_period.robot.name, robot_period.down)
        assert row[8][0] == availability(robot_period.availability)


def test_bar_lengths_are_proportional_to_the_durations_of_the_parts() -> None:
    found = findings([fleet.robot("r", [fleet.restart(1, 700.0)])], DAY)
    bars = [e for e in Read(written(found)).all("rect") if (e["class"] or "").startswith("part ")]
    widths = {(bar["class"] or "").split()[1]: float((bar["width"] or "").rstrip("%")) for bar in bars}
    (group,) = found.groups
    for part, seconds in group.parts.items():
        assert widths[part] / widths["cluster"] == pytest.approx(seconds / group.parts["cluster"], rel=1e-3)


def test_a_robot_that_missed_no_output_has_a_gap_of_zero() -> None:
    reflex = fleet.switchover(1, 700.0)
    reflex.moments.first_output = reflex.moments.last_output
    (row,) = read(fleet.robot("r", [reflex])).table("Gap by strategy")
    assert [value(cell) for cell in row[2:]] == [0.0] * 5


def test_every_figure_is_described_and_has_a_table() -> None:
    shown = Read(written(findings(fleet.robots(), DAY, fleet.pods())))
    charts = [e for e in shown.all("svg") if e.get("role") == "img"]
    assert len(charts) == len(shown.all("figure")) == 4
    assert all(e["aria-label"] for e in charts)
    assert_golden("report", charts[0]["aria-label"] or "", "Restart", "n = 2", "3.68 s")
    assert len(shown.tables) == 5
    assert shown.all("html")[0]["lang"] == "en"


def test_reserved_resources_are_shown_by_strategy() -> None:
    shown = Read(written(findings([fleet.whole()], DAY, fleet.pods())))
    executing, pool = shown.table("Reserved CPU")
    assert (executing[0][0], [value(cell) for cell in executing[2:6]]) == ("Executing", [0.5, 0.52, 0.1, 0.0])
    assert (pool[0][0], value(pool[6])) == ("pool spare", 2.0)
    assert "No pod of these robots requests CPU" in read(fleet.whole()).text
    why = "you may not list pods"
    assert_golden("report", Read(written(findings([fleet.whole()], DAY, pods_unknown=why))).texts_with(why), why)


def test_names_and_messages_are_escaped() -> None:
    shown = read(fleet.hostile())
    assert len(shown.all("script")) == 1, "our own"
    assert shown.all("img") == []
    assert not any(name.startswith("on") for _, attributes in shown.elements for name in attributes)
    assert "<script>alert(1)</script>" in shown.text
    assert "\u202e" not in shown.text


def test_the_page_fetches_nothing_and_permits_no_other_script() -> None:
    text = written(findings(fleet.robots(), DAY))
    assert not re.search(r"""(?:src|href|url\()\s*=?\s*["']?(?!data:)(?:https?:)?//""", text)
    (policy,) = (e["content"] or "" for e in Read(text).all("meta") if e.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; ")
    for tag in ("script", "style"):
        (body,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert f"'sha256-{base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()}'" in policy


def test_the_data_can_be_downloaded_from_the_page() -> None:
    found = findings(fleet.robots(), DAY)
    links = {e["download"]: e["href"] or "" for e in Read(written(found)).all("a")}
    held = {name: base64.b64decode(link.partition("base64,")[2]).decode() for name, link in links.items()}
    assert held == sheets(found)


def test_incomplete_data_is_reported_first() -> None:
    assert "The data on this period is incomplete." in read(*fleet.robots()).text
    texts = read(fleet.forgetful()).texts_with("of 12", "all 12")
    assert_golden("report", texts, "robot-2-drive: 2 of 12", "2026-11-22 04:06:24Z", "all 12 recoveries", "10 are")
    assert "The data on this period is incomplete" not in read(fleet.whole()).text
    assert_golden("report", read(fleet.quiet()).texts_with("no recovery"), "no recovery")


def test_only_robots_with_events_have_a_lane() -> None:
    shown = read(*fleet.robots())
    assert shown.texts.count("robot-1-drive") > shown.texts.count("robot-5-drive") == 1, "it is in the table of robots"
    assert "1 robot without an event is not shown." in shown.text


def test_the_page_reports_that_a_period_has_no_recoveries() -> None:
    texts = read(fleet.in_vain(), period=Span(NOW - 60.0, NOW)).texts_with("No recovery", "No interruption")
    assert_golden("report", texts, "2026-11-22 13:06:24Z", "No recovery", "No interruption")


def test_a_failed_recovery_is_shown_with_all_attempts() -> None:
    texts = read(fleet.in_vain()).texts_with("Fallback/Executing", "Restart with", "FAILED")
    assert_golden("report", texts, "Fallback/Executing", "Restart with robot-z9", "60 s", "FAILED")


def test_robots_of_several_namespaces_are_distinguished() -> None:
    other = fleet.quiet()
    other["metadata"]["namespace"] = "lab"
    assert [row[0][0] for row in read(fleet.whole(), other).table("Robots:")] == [
        "fleet/robot-1-drive",
        "lab/robot-5-drive",
    ]


@pytest.mark.parametrize(
    ("share", "words"), [(1.0, "100 %"), (0.9999999, "99.999 %"), (0.97912, "97.912 %"), (0.5, "50 %"), (None, "–")]
)
def test_an_availability_is_never_rounded_up(share: float | None, words: str) -> None:
    assert availability(share) == words
