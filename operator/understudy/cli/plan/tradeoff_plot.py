"""Draws recovery time against CPU for each possible strategy of a workload."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from understudy.advice import order_explanation
from understudy.advice.strategy_order import Order, RatedStrategy, most_cost, required_time
from understudy.cli.common import palette, plot_files
from understudy.cli.plan.recommendation import Recommendation
from understudy.trees.core.leaf import duration

_LEAST = 0.005
"""The shortest time in the plot, in seconds."""

_NEAR = 1.35
"""Strategies whose times differ by less than this factor have labels above and below their marks."""


def draw(file: str, found: Recommendation) -> None:
    """Draw the plot into a file. Raises CommandError if it cannot be written."""
    from matplotlib.ticker import FuncFormatter

    order = found.order
    axes = plot_files.axes(9.0, 5.2)
    every = (*order.chosen, *order.left_out)
    times = [max(_LEAST, one.seconds.value) for one in every]
    bottom, top = min(times) / 2.5, max(times) * 2.5
    right = max(1.1, 1.25 * max(one.cost for one in every))
    within, most = required_time(order.requirements), most_cost(order.requirements)
    axes.fill_between(
        [-0.06 * right, min(most, right)], bottom, min(within, top), color=palette.ALLOWED, alpha=0.10, linewidth=0,
        label="fast enough and cheap enough",
    )  # fmt: skip
    for one in every:
        _mark(axes, order, one, below=_crowded(one, every), left=one.cost > 0.6 * right)
    first = order_explanation.strategy_name(order.first.candidate)
    axes.plot([], [], "o", color=palette.CHOSEN, label=f"in the order, first {first}")
    axes.plot([], [], "o", color=palette.LEFT_OUT, markerfacecolor="white", label="left out")
    axes.set_yscale("log")
    axes.set_ylim(bottom, top)
    axes.set_xlim(-0.06 * right, right)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: duration(value)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value * 100:g} %"))
    axes.set_xlabel("CPU reserved for this workload, % of a working instance")
    axes.set_ylabel("time from detection to recovery")
    axes.set_title(f"{found.workload.name}\n{_levels(order)}", loc="left", fontsize=10)
    axes.legend(loc="upper right", frameon=False, fontsize=9)
    plot_files.save(axes, file)


def _mark(axes: Any, order: Order, one: RatedStrategy, *, below: bool, left: bool) -> None:
    """Draw a strategy with its label, which is below or left of the mark if it would overlap another or the border."""
    chosen = one in order.chosen
    colour = palette.CHOSEN if chosen else palette.LEFT_OUT
    where = (one.cost, max(_LEAST, one.seconds.value))
    axes.plot(
        *([part] for part in where), marker="o", markersize=11 if one == order.first else 7.5, color=colour,
        markerfacecolor=colour if chosen else "white", linestyle="none",
    )  # fmt: skip
    place = f"{order.chosen.index(one) + 1}. " if chosen else ""
    axes.annotate(
        f"{place}{order_explanation.strategy_name(one.candidate)}, {order_explanation.describe_time(one)}", where,
        xytext=(-9 if left else 9, -13 if below else 6), textcoords="offset points", ha="right" if left else "left", fontsize=8.5,
        color=colour if chosen else palette.FAINT,
    )  # fmt: skip


def _crowded(one: RatedStrategy, every: Sequence[RatedStrategy]) -> bool:
    """Return whether another strategy takes only a little longer."""
    return any(1 < other.seconds.value / max(_LEAST, one.seconds.value) < _NEAR for other in every)


def _levels(order: Order) -> str:
    return ", ".join(f"{name} {level}" for name, level in order.requirements.to_wire().items())
