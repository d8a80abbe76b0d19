"""Formats the data as CSV for spreadsheets and pandas, with full precision. Pure."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence

from understudy.api.kinds.robot_workload import Moments
from understudy.cli.common.robots import Robot
from understudy.cli.common.text.recovery_text import parts_of
from understudy.cli.common.text.time_bars import NAMES
from understudy.cli.report.recovery_records import Entry, Findings, Group, RobotPeriod, Span
from understudy.cli.report.reserved_resources import ROLES, Share
from understudy.failover.progress import rfc3339

Value = str | int | float | bool | None
Row = Mapping[str, Value]

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of a text that a spreadsheet interprets as a formula."""


def sheets(findings: Findings) -> dict[str, str]:
    """Return the sheets by file name."""
    return {
        "recoveries.csv": _written([_recovery(entry) for entry in findings.entries], _recovery_columns()),
        "robots.csv": _written(
            [_robot(robot_period, findings.period) for robot_period in findings.robot_periods], _ROBOT
        ),
        "strategies.csv": _written([_strategy(group) for group in findings.groups], _STRATEGY),
        "reserved.csv": _written([row for share in findings.shares for row in _reserved(share)], _RESERVED),
    }


def _written(rows: Sequence[Row], columns: Sequence[str]) -> str:
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, lineterminator="\r\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return out.getvalue()


def _cell(value: Value) -> str:
    """Format a value; a text that looks like a formula gets an apostrophe, because names and messages come from others."""
    if isinstance(value, str):
        return f"'{value}" if value.startswith(_FORMULA) else value
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else repr(round(value, 6))


def _recovery_columns() -> list[str]:
    return [
        *("namespace", "robot", "number", "id", "began", "result", "strategy", "planned", "switchover", "resumed"),
        *("from_pod", "to_pod", "epoch", *(f"{part}_seconds" for part in NAMES)),
        *("recovery_seconds", "held_seconds", "down_seconds", "gap_seconds", "reason", "attempts"),
        *Moments.model_fields,
    ]


def _recovery(entry: Entry) -> Row:
    recovery = entry.recovery
    return {
        "namespace": entry.namespace,
        "robot": entry.name,
        "number": recovery.number,
        "id": recovery.id,
        "began": rfc3339(entry.began),
        "result": recovery.result,
        "strategy": recovery.strategy,
        "planned": recovery.planned,
        "switchover": recovery.switchover,
        "resumed": recovery.resumed,
        "from_pod": recovery.from_pod,
        "to_pod": recovery.to_pod,
        "epoch": recovery.epoch,
        **{f"{part}_seconds": seconds for part, seconds in parts_of(recovery).items()},
        "recovery_seconds": recovery.recovery_seconds,
        "held_seconds": entry.held,
        "down_seconds": entry.down,
        "gap_seconds": entry.gap,
        "reason": recovery.reason,
        "attempts": json.dumps([attempt.to_wire() for attempt in recovery.attempts]),
        **recovery.moments.model_dump(),
    }


_ROBOT = (
    *("namespace", "robot", "policy", "health", "protected", "problems", "period_begin", "period_end"),
    *(
        "known_begin",
        "known_end",
        "recoveries_ever",
        "recoveries_kept",
        "recoveries",
        "failures",
        "recovered",
        "failed",
    ),
    *("down_seconds", "down_at_least", "availability"),
)


def _robot(robot_period: RobotPeriod, period: Span) -> Row:
    robot, known = robot_period.robot, robot_period.known
    return {
        "namespace": robot.namespace,
        "robot": robot.name,
        "policy": robot.policy,
        "health": robot.health,
        "protected": robot.protected,
        "problems": _problems(robot),
        "period_begin": rfc3339(period.begin),
        "period_end": rfc3339(period.end),
        "known_begin": rfc3339(known.begin) if known else None,
        "known_end": rfc3339(known.end) if known else None,
        "recoveries_ever": robot_period.ever,
        "recoveries_kept": robot_period.kept,
        "recoveries": len(robot_period.entries),
        "failures": sum(entry.of_failure for entry in robot_period.entries),
        "recovered": sum(entry.recovered for entry in robot_period.entries),
        "failed": sum(entry.failed for entry in robot_period.entries),
        "down_seconds": robot_period.down if known else None,
        "down_at_least": robot_period.down_at_least,
        "availability": robot_period.availability,
    }


def _problems(robot: Robot) -> str:
    return json.dumps([problem.to_wire() for problem in robot.problems])


_STRATEGY = (
    *("strategy", "count", *(f"{part}_mean_seconds" for part in NAMES)),
    *("mean_seconds", "p50_seconds", "p95_seconds", "least_seconds", "greatest_seconds"),
)


def _strategy(group: Group) -> Row:
    spread = group.spread
    return {
        "strategy": group.name,
        "count": spread.count,
        **{f"{part}_mean_seconds": seconds for part, seconds in group.parts.items()},
        "mean_seconds": spread.mean,
        "p50_seconds": spread.p50,
        "p95_seconds": spread.p95,
        "least_seconds": spread.least,
        "greatest_seconds": spread.greatest,
    }


_RESERVED = ("strategy", "count", "role", "cpu_cores", "memory_bytes")


def _reserved(share: Share) -> Iterator[Row]:
    for role, amounts in share.roles.items():
        values = {"cpu_cores": amounts.cpu, "memory_bytes": amounts.memory}
        yield {"strategy": share.name, "count": share.count, "role": ROLES[role], **values}
