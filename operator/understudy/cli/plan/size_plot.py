"""Draws risk against cost by number of fallbacks."""

from __future__ import annotations

import math

from understudy.cli.common import palette, plot_files
from understudy.cli.plan.pool_sizes import Size, outcome
from understudy.cli.plan.size_text import percent

_LEAST = 1e-4
"""The lowest risk that is drawn."""

_COLOURS = {"waiting": palette.BLUE, "loss": palette.VERMILLION, "window": palette.GREEN}
_WORDS = {
    "waiting": "has to wait for a fallback (Erlang C)",
    "loss": "finds no fallback (Erlang B)",
    "window": "more failures than fallbacks within a refill",
}


def draw(file: str, size: Size) -> None:
    """Draw the plot into a file. Raises CommandError if it cannot be written."""
    from matplotlib.ticker import FuncFormatter

    question, chosen = size.question, size.outcome.fallbacks
    counts = range(_last(size) + 1)
    outcomes = [outcome(question, count) for count in counts]
    axes = plot_files.axes(9.0, 5.2, hidden=("right",))
    for measure, words in _WORDS.items():
        values = [getattr(one, measure) for one in outcomes]
        here = getattr(size.outcome, measure)
        label = f"{words}: {percent(here)} with {chosen}"
        axes.plot(counts, values, color=_COLOURS[measure], marker="o", markersize=3.5, linewidth=1.4, label=label)
        axes.plot([chosen], [here], color=_COLOURS[measure], marker="o", markersize=8)
    if size.risk is not None:
        axes.axhline(size.risk, color=palette.FAINT, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.annotate(
            f"required: {percent(size.risk)}", (counts[-1], size.risk), xytext=(0, 4), textcoords="offset points",
            ha="right", fontsize=8.5, color=palette.FAINT,
        )  # fmt: skip
    axes.set_yscale("log")
    axes.set_ylim(_LEAST, 1.3)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: percent(value)))
    axes.set_xlim(-0.02 * counts[-1], counts[-1] * 1.02)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("fallbacks in the pool")
    axes.set_ylabel("probability per failure or window")
    if step := question.cpu / question.robots * 100:
        costs = axes.secondary_xaxis("top", functions=(lambda x: x * step, lambda x: x / step))
        costs.set_xlabel("added CPU, % of what the robots' instances use")
    axes.set_title(
        f"{question.robots} robots, failures per robot and hour: {question.failures_per_robot_hour:g}, refilled in {question.refill:g} s",
        loc="left", fontsize=11, fontweight="bold",
    )  # fmt: skip
    axes.axvline(chosen, color=palette.RULE, linewidth=0.8)
    axes.legend(loc="lower left", frameon=False, fontsize=9)
    plot_files.save(axes, file)


def _last(size: Size) -> int:
    """Return the highest number of fallbacks in the plot: all risks are below the axis there."""
    count = max(4, size.outcome.fallbacks, math.ceil(size.question.demand.offered))
    while outcome(size.question, count).waiting > _LEAST and count < 100_000:
        count += max(1, count // 20)
    return count
