"""Builds the table of precedence in ``docs/limits.md`` from ``failover/decide.py``."""

from __future__ import annotations

from understudy.failover.decide import LIMITS, TRIGGERS, LimitRow, Trigger

BEGIN = "<!-- precedence: written by scripts/generate from operator/understudy/failover/decide.py -->"
END = "<!-- end of precedence -->"


def table() -> str:
    """Return the triggers in order, and for each limit in order what it leads to, as Markdown."""
    lines = ["| | trigger | decision | limits that apply |", "| --- | --- | --- | --- |"]
    for number, trigger in enumerate(TRIGGERS, 1):
        applied = dict.fromkeys(f"`{row.reason}`" for row in LIMITS if trigger.trigger in row.triggers)
        action = trigger.decision.__name__
        lines.append(f"| {number} | `{trigger.trigger}` | {action} | {', '.join(applied) or 'none'} |")
    lines += ["", "| | limit | reason | applies to | decision | message |", "| --- | --- | --- | --- | --- | --- |"]
    lines += [_limit(number, row) for number, row in enumerate(LIMITS, 1)]
    return "\n".join(lines)


def _limit(number: int, row: LimitRow) -> str:
    triggers = ", ".join(f"`{trigger}`" for trigger in Trigger if trigger in row.triggers)
    message = row.message.replace("{words}", "*details*").replace("{left}", "*n*")
    return f"| {number} | {row.limit} | `{row.reason}` | {triggers} | {row.decision.__name__} | {message} |"
