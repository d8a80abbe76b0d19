"""Tells a recommendation as a table: what each strategy takes, what it costs, and why it has its place."""

from __future__ import annotations

from understudy.advice import order_explanation
from understudy.advice.strategy_order import Judged, Order
from understudy.cli.plan.recommendation import Recommendation
from understudy.trees.core.leaf import duration

_HEAD = ("", "STRATEGY", "RECOVERS IN", "", "CPU KEPT", "", "WHY")
_RIGHT = (2, 4)
"""Columns of figures."""


def told(found: Recommendation) -> str:
    """All of it, for a terminal."""
    order = found.order
    where = f"{found.workload.namespace}/" if found.workload.namespace else ""
    lines = [
        f"{where}{found.workload.name}, FailurePolicy {found.policy.name}",
        f"asked for  {order_explanation.asked(order.requirements)}",
        "",
        *_table(order),
        "",
    ]
    lines += [f"not met    {problem}" for problem in order_explanation.unmet(order)]
    lines.append(f"policy     {_policy(found)}")
    if any(one.seconds.source == "published" for one in (*order.chosen, *order.left_out)):
        lines.append(
            "published  measured with this project's navigation stack, see docs/choosing.md; another application has other times"
        )
    return "\n".join(lines)


def _policy(found: Recommendation) -> str:
    if found.auto:
        return "leaves its strategies to be chosen: with these requirements and figures this is the order"
    stated = "" if found.stated else ", and states no requirements: the defaults were taken"
    return f"has its strategies written out: {found.present}{stated}"


def _table(order: Order) -> list[str]:
    rows = [_HEAD]
    rows += [_row(f"{place}.", order, one) for place, one in enumerate(order.chosen, 1)]
    rows += [_row("-", order, one) for one in order.left_out]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]
    return [
        "  ".join(
            cell.rjust(width) if column in _RIGHT else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _row(place: str, order: Order, one: Judged) -> tuple[str, str, str, str, str, str, str]:
    # A restart keeps nothing, which needs no figure.
    cpu, known = (f"{one.cost * 100:.3g} %", one.cpu.source) if one.candidate.pool else ("0 %", "")
    seconds = duration(float(f"{one.seconds.value:.3g}"))
    why = order_explanation.why(order, one)
    return place, order_explanation.named(one.candidate), seconds, one.seconds.source, cpu, known, why
