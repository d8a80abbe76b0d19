"""Formats the data as CSV for spreadsheets and pandas, with full precision. Pure."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TypeVar

from understudy.api.kinds.robot_workload import Moments
from understudy.cli.common.text.recovery_text import parts_of
from understudy.cli.common.text.time_bars import NAMES
from understudy.cli.report.recovery_records import Entry, Findings, Group, RobotPeriod, Span
from understudy.cli.report.reserved_resources import ROLES, Share
from understudy.failover.progress import rfc3339

Value = str | int | float | bool | None
Row = TypeVar("Row")

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of a text that a spreadsheet interprets as a formula."""


def sheets(findings: Findings) -> dict[str, str]:
    """Return the sheets by file name."""
    reserved = [(share, role) for share in findings.shares for role in share.roles]
    return {
        "recoveries.csv": _written(_RECOVERY, findings.entries),
        "robots.csv": _written(_robot(findings.period), findings.robot_periods),
        "strategies.csv": _written(_STRATEGY, findings.groups),
        "reserved.csv": _written(_RESERVED, reserved),
    }


def _written(columns: Mapping[str, Callable[[Row], Value]], rows: Iterable[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(columns)
    writer.writerows([_cell(value(row)) for value in columns.values()] for row in rows)
    return out.getvalue()


def _cell(value: Value) -> str:
    """Format a value; a text that looks like a formula gets an apostrophe, because names and messages come from others."""
    if isinstance(value, str):
        return f"'{value}" if value.startswith(_FORMULA) else value
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else repr(round(value, 6))


def _part(part: str, entry: Entry) -> Value:
    return parts_of(entry.recovery).get(part)


def _moment(moment: str, entry: Entry) -> Value:
    found: str | None = getattr(entry.recovery.moments, moment)
    return found


_RECOVERY: Mapping[str, Callable[[Entry], Value]] = {
    "namespace": lambda entry: entry.namespace,
    "robot": lambda entry: entry.name,
    "number": lambda entry: entry.recovery.number,
    "id": lambda entry: entry.recovery.id,
    "began": lambda entry: rfc3339(entry.began),
    "result": lambda entry: entry.recovery.result,
    "strategy": lambda entry: entry.recovery.strategy,
    "planned": lambda entry: entry.recovery.planned,
    "switchover": lambda entry: entry.recovery.switchover,
    "resumed": lambda entry: entry.recovery.resumed,
    "from_pod": lambda entry: entry.recovery.from_pod,
    "to_pod": lambda entry: entry.recovery.to_pod,
    "epoch": lambda entry: entry.recovery.epoch,
    **{f"{part}_seconds": partial(_part, part) for part in NAMES},
    "recovery_seconds": lambda entry: entry.recovery.recovery_seconds,
    "held_seconds": lambda entry: entry.held,
    "down_seconds": lambda entry: entry.down,
    "gap_seconds": lambda entry: entry.gap,
    "reason": lambda entry: entry.recovery.reason,
    "attempts": lambda entry: json.dumps([attempt.to_wire() for attempt in entry.recovery.attempts]),
    **{moment: partial(_moment, moment) for moment in Moments.model_fields},
}


def _robot(period: Span) -> Mapping[str, Callable[[RobotPeriod], Value]]:
    return {
        "namespace": lambda one: one.robot.namespace,
        "robot": lambda one: one.robot.name,
        "policy": lambda one: one.robot.policy,
        "health": lambda one: one.robot.health,
        "protected": lambda one: one.robot.protected,
        "problems": lambda one: json.dumps([problem.to_wire() for problem in one.robot.problems]),
        "period_begin": lambda _: rfc3339(period.begin),
        "period_end": lambda _: rfc3339(period.end),
        "known_begin": lambda one: rfc3339(one.known.begin) if one.known else None,
        "known_end": lambda one: rfc3339(one.known.end) if one.known else None,
        "recoveries_ever": lambda one: one.ever,
        "recoveries_kept": lambda one: one.kept,
        "recoveries": lambda one: len(one.entries),
        "failures": lambda one: sum(entry.of_failure for entry in one.entries),
        "recovered": lambda one: sum(entry.recovered for entry in one.entries),
        "failed": lambda one: sum(entry.failed for entry in one.entries),
        "down_seconds": lambda one: one.down if one.known else None,
        "down_at_least": lambda one: one.down_at_least,
        "availability": lambda one: one.availability,
    }


_STRATEGY: Mapping[str, Callable[[Group], Value]] = {
    "strategy": lambda group: group.name,
    "count": lambda group: group.spread.count,
    **{f"{part}_mean_seconds": partial(lambda part, group: group.parts[part], part) for part in NAMES},
    "mean_seconds": lambda group: group.spread.mean,
    "p50_seconds": lambda group: group.spread.p50,
    "p95_seconds": lambda group: group.spread.p95,
    "least_seconds": lambda group: group.spread.least,
    "greatest_seconds": lambda group: group.spread.greatest,
}

_RESERVED: Mapping[str, Callable[[tuple[Share, str]], Value]] = {
    "strategy": lambda row: row[0].name,
    "count": lambda row: row[0].count,
    "role": lambda row: ROLES[row[1]],
    "cpu_cores": lambda row: row[0].roles[row[1]].cpu,
    "memory_bytes": lambda row: row[0].roles[row[1]].memory,
}
