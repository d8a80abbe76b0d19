"""Formats robots and pools as one screen of text that fits the width of the terminal. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

from understudy.api.kinds.robot_workload import Health
from understudy.api.plain_text import plain
from understudy.cli.common.robots import UNWATCHED, LastRecovery, Pool, Problem, Robot, is_reported, summary
from understudy.cli.common.text import text_tables
from understudy.cli.common.text.text_tables import Cell
from understudy.cli.common.text.time_bars import length, short
from understudy.cli.common.text.tree_text import coloured
from understudy.cli.common.text.wording import age, counted, listed, wrapped

MOST_LINES = 3
"""Most lines per problem in a terminal; ``understudy explain`` shows all of it."""

NO_INSTANCE = "none"

_LONGEST_HEALTH = max(len(health) for health in (*get_args(Health), UNWATCHED))
"""Keeps the columns in place when a health changes."""


@dataclass(frozen=True)
class Layout:
    """How the screen is formatted."""

    now: float
    columns: int | None = None
    """The width of the terminal; None for no limit."""
    colours: bool = False
    namespaces: bool = False
    """Whether to show namespaces."""
    wide: bool = False


def lines(robots: Sequence[Robot], pools: Sequence[Pool], layout: Layout) -> Iterator[str]:
    """Format everything."""
    yield from _body(robots, pools, layout)
    yield ""
    yield from wrapped(summary(robots), layout.columns, indent=0, hanging=2)


def screenful(robots: Sequence[Robot], pools: Sequence[Pool], layout: Layout, rows: int) -> list[str]:
    """Format what fits into so many rows. If not everything fits, robots with problems come first."""
    shown = list(lines(robots, pools, layout))
    if len(shown) <= rows:
        return shown
    ordered = sorted(robots, key=lambda robot: robot.is_well)
    head = [*wrapped(summary(robots), layout.columns, indent=0, hanging=2), ""]
    shown = [*head, *_body(ordered, pools, layout)]
    hidden = len(shown) - (rows - 1)
    return [*shown[: rows - 1], f"… {counted(hidden, 'more line')}: enlarge the window, or name robots"]


def _body(robots: Sequence[Robot], pools: Sequence[Pool], layout: Layout) -> Iterator[str]:
    yield from _rows(robots, layout)
    if pools:
        yield ""
        known = [problem.message for robot in robots for problem in robot.problems]
        yield from _pools(pools, known, layout)


def in_a_line(robot: Robot) -> str:
    """Format one robot with all of its problems as one line."""
    parts = [
        f"{robot.namespace}/{robot.name}",
        robot.health,
        "protected" if robot.protected else "NOT PROTECTED",
        f"active {robot.active or NO_INSTANCE} (epoch {robot.epoch})",
        f"standby {robot.standby}",
    ]
    if robot.last_recovery is not None:
        parts.append(f"last recovery #{robot.last_recovery.number} {_how(robot.last_recovery)}")
    parts += [f"{problem.about} ({problem.reason}): {problem.message}" for problem in robot.problems]
    return plain("; ".join(parts))


def _rows(robots: Sequence[Robot], layout: Layout) -> Iterator[str]:
    """Format the widest set of columns that fits, with the problems of each robot below its row."""
    column_sets = [_WIDE] if layout.wide else [_FULL, _MIDDLE, _NARROW, _NARROWEST]
    for columns in column_sets:
        rows = [
            [Cell(head) for head, _ in columns],
            *([draw(robot, layout) for _, draw in columns] for robot in robots),
        ]
        if layout.namespaces:
            rows = [
                [Cell(name), *row]
                for name, row in zip(["NAMESPACE", *(r.namespace for r in robots)], rows, strict=True)
            ]
        if layout.wide or layout.columns is None or text_tables.width(rows) <= layout.columns:
            head, *body = text_tables.format_table(rows, colours=layout.colours)
            yield head
            for robot, line in zip(robots, body, strict=True):
                yield line
                yield from _problem_lines(robot.problems, layout)
            return
    for robot in robots:
        yield from _stacked(robot, layout)


def _stacked(robot: Robot, layout: Layout) -> Iterator[str]:
    """Format a robot for a narrow terminal."""
    name = f"{robot.namespace}/{robot.name}" if layout.namespaces else robot.name
    yield f"{plain(name)}  {_health(robot, layout).format(0, colours=layout.colours).rstrip()}"
    parts = [
        "protected" if robot.protected else "NOT PROTECTED",
        f"active {_active(robot, in_short=True)}",
        f"standby {robot.standby}",
        f"last recovery {_last(robot, layout.now, _time)}" if robot.last_recovery else "",
    ]
    yield from wrapped(listed(parts), layout.columns, indent=2)
    yield from _problem_lines(robot.problems, layout)


def _problem_lines(problems: Sequence[Problem], layout: Layout) -> Iterator[str]:
    for problem in problems:
        since = f", {age(problem.since, layout.now)}" if problem.since else ""
        head = f"{problem.about} ({problem.reason}{since}):"
        shown = wrapped(f"{head} {problem.message}", layout.columns, indent=2, hanging=4)
        if layout.columns is not None and len(shown) > MOST_LINES:
            last = f"{shown[MOST_LINES - 1]} "[: layout.columns - 2]
            shown = [*shown[: MOST_LINES - 1], f"{last.rpartition(' ')[0]} …"]
        state = "Degraded" if problem.type == "Degraded" else "Failed"
        yield from (
            line.replace(head, coloured(head, state, colours=layout.colours), 1) if index == 0 else line
            for index, line in enumerate(shown)
        )


def _pools(pools: Sequence[Pool], known: Sequence[str], layout: Layout) -> Iterator[str]:
    """Format a table of pools with their problems, except those ``known`` from a robot: pools report their pods' problems too."""
    names = [f"{pool.namespace}/{pool.name}" if layout.namespaces else pool.name for pool in pools]
    rows = [
        [Cell("POOL"), Cell("READINESS"), Cell("READY"), Cell("CLAIMED")],
        *(
            [
                Cell(name),
                Cell(pool.readiness),
                Cell(f"{pool.ready}/{pool.desired}", "Failed" if pool.is_short else ""),
                Cell(str(pool.claimed)),
            ]
            for name, pool in zip(names, pools, strict=True)
        ),
    ]
    head, *body = text_tables.format_table(rows, colours=layout.colours)
    if layout.columns is not None and text_tables.width(rows) > layout.columns:
        body = [f"pool {name}: {pool.ready} of {pool.desired} ready" for name, pool in zip(names, pools, strict=True)]
    else:
        yield head
    for pool, line in zip(pools, body, strict=True):
        yield line
        yield from _problem_lines([problem for problem in pool.problems if not is_reported(problem, known)], layout)


def _active(robot: Robot, *, in_short: bool = False) -> str:
    name = robot.active
    if in_short and name.startswith(f"{robot.name}-"):
        name = short([name])[name]
    return f"{name or NO_INSTANCE} ({robot.epoch})"


def _health(robot: Robot, layout: Layout) -> Cell:
    return Cell(robot.health.ljust(_LONGEST_HEALTH), "Failed" if robot.health == UNWATCHED else robot.health)


def _protected(robot: Robot, layout: Layout) -> Cell:
    return Cell("yes", "Healthy") if robot.protected else Cell("NO", "Failed")


def _last(robot: Robot, now: float, how: Callable[[LastRecovery], str]) -> str:
    last = robot.last_recovery
    if last is None:
        return "none"
    return listed((how(last), _ended(last, now)))


def _ended(last: LastRecovery, now: float) -> str:
    return f"{age(last.ended, now)} ago" if last.ended else ""


def _how(last: LastRecovery) -> str:
    """Format the strategy and the recovery time."""
    if last.result != "Recovered" or last.recovery_seconds is None:
        return "FAILED" if last.result == "Failed" else last.result.lower()
    return f"{length(last.recovery_seconds)} by {last.strategy}{' (planned)' if last.planned else ''}"


def _time(last: LastRecovery) -> str:
    return length(last.recovery_seconds) if last.recovery_seconds is not None else _how(last)


_Columns = Sequence[tuple[str, Callable[[Robot, Layout], Cell]]]

_SHORT: _Columns = [
    ("ROBOT", lambda robot, layout: Cell(robot.name)),
    ("HEALTH", _health),
    ("ACTIVE", lambda robot, layout: Cell(_active(robot, in_short=True))),
    ("STANDBY", lambda robot, layout: Cell(robot.standby.replace("(", "").replace(")", ""))),
]
_LAST: _Columns = [("LAST", lambda robot, layout: Cell(_last(robot, layout.now, _time)))]
_WHEN: _Columns = [
    ("LAST", lambda robot, layout: Cell(_ended(robot.last_recovery, layout.now) if robot.last_recovery else "none"))
]

_MIDDLE: _Columns = [*_SHORT[:2], ("PROTECTED", _protected), *_SHORT[2:], *_LAST]
# The problems below say which robots are not protected.
_NARROW: _Columns = [*_SHORT, *_LAST]
_NARROWEST: _Columns = [*_SHORT, *_WHEN]

_FULL: _Columns = [
    ("ROBOT", lambda robot, layout: Cell(robot.name)),
    ("HEALTH", _health),
    ("PROTECTED", _protected),
    ("ACTIVE (EPOCH)", lambda robot, layout: Cell(_active(robot))),
    ("STANDBY", lambda robot, layout: Cell(robot.standby)),
    ("LAST RECOVERY", lambda robot, layout: Cell(_last(robot, layout.now, _how))),
]

_WIDE: _Columns = [
    *_FULL,
    ("RECOVERIES", lambda robot, layout: Cell(str(robot.recovery_count))),
    ("NEXT", lambda robot, layout: Cell(robot.strategy or "Unknown")),
    ("SITUATION", lambda robot, layout: Cell(robot.situation or "none")),
    ("POLICY", lambda robot, layout: Cell(robot.policy)),
    ("GATE", lambda robot, layout: Cell(robot.gate)),
    ("AGE", lambda robot, layout: Cell(age(robot.created, layout.now) if robot.created else "")),
]
