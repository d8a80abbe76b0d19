"""Formats a recommendation as a table: time, cost and reason of each strategy."""

from __future__ import annotations

from understudy.advice import order_explanation
from understudy.advice.strategy_order import Order, RatedStrategy
from understudy.cli.common.text.text_tables import format_texts
from understudy.cli.plan.recommendation import Recommendation
from understudy.trees.core.leaf import duration

_HEAD = ("", "STRATEGY", "RECOVERS IN", "", "CPU RESERVED", "", "WHY")
_RIGHT = (2, 4)
"""Columns that are aligned to the right."""


def lines(found: Recommendation) -> str:
    """Format the recommendation for a workload."""
    order = found.order
    where = f"{found.workload.namespace}/" if found.workload.namespace else ""
    text = [
        f"{where}{found.workload.name}, FailurePolicy {found.policy.name}",
        f"required   {order_explanation.describe_requirements(order.requirements)}",
        "",
        *_table(order),
        "",
    ]
    text += [f"not met    {problem}" for problem in order_explanation.unmet_requirements(order)]
    text.append(f"policy     {_policy(found)}")
    if any(one.seconds.source == "published" for one in (*order.chosen, *order.left_out)):
        text.append(
            "published  measured with this project's navigation stack, see docs/choosing.md; other applications differ"
        )
    return "\n".join(text)


def _policy(found: Recommendation) -> str:
    if found.auto:
        return "chooses its strategies automatically: this order applies"
    stated = "" if found.stated else ", and states no requirements, so the defaults were used"
    return f"lists its strategies: {found.present}{stated}"


def _table(order: Order) -> list[str]:
    rows = [_HEAD]
    rows += [_row(f"{place}.", order, one) for place, one in enumerate(order.chosen, 1)]
    rows += [_row("-", order, one) for one in order.left_out]
    return format_texts(rows, right=_RIGHT)


def _row(place: str, order: Order, one: RatedStrategy) -> tuple[str, str, str, str, str, str, str]:
    # A restart reserves nothing.
    cpu, known = (f"{one.cost * 100:.3g} %", one.cpu.source) if one.candidate.pool else ("0 %", "")
    seconds = duration(float(f"{one.seconds.value:.3g}"))
    why = order_explanation.describe_choice(order, one)
    return place, order_explanation.strategy_name(one.candidate), seconds, one.seconds.source, cpu, known, why
