"""Pictures of a run: the time of claims, the time until all robots had recovered, and the growth of figures with the
fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from understudy.cli.common import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _axes(width: float = 7.0) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.grid(color=palette.GRID, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def latencies(values: Mapping[int, Sequence[float]], bound: float, path: Path, *, title: str) -> None:
    """Draw the share of claims that took at most a given time (in ms), by number of robots. The bound is for the 99th
    percentile."""
    figure, axes = _axes()
    for colour, (robots, found) in zip(palette.SERIES, sorted(values.items()), strict=False):
        ordered = sorted(found)
        shares = [(n + 1) / len(ordered) for n in range(len(ordered))]
        axes.step(ordered, shares, where="post", color=colour, label=f"{robots} robots ({len(ordered)} claims)")
    axes.plot(
        [bound], [0.99], marker="x", color=palette.LIMIT, linestyle="none", label=f"bound: 99 % within {bound:g} ms"
    )
    axes.set(xscale="log", xlabel="ms from the decision to the API server's answer", ylim=(0, 1.02), title=title)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def recoveries(values: Mapping[int, Sequence[float]], path: Path, *, title: str) -> None:
    """Draw how many robots are driven again at each second after all of them failed, by number of robots."""
    figure, axes = _axes()
    for colour, (robots, found) in zip(palette.SERIES, sorted(values.items()), strict=False):
        ordered = sorted(found)
        axes.step([0.0, *ordered], range(len(ordered) + 1), where="post", color=colour, label=f"{robots} robots")
    axes.set(
        xlabel="s after the failures",
        ylabel="robots that are driven again",
        xlim=(0, None),
        ylim=(0, None),
        title=title,
    )
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def growth(values: Mapping[str, Mapping[int, float]], path: Path, *, title: str) -> None:
    """Draw figures over the number of robots, each as a multiple of its value for the fewest robots."""
    figure, axes = _axes(10.0)
    sizes = sorted({size for found in values.values() for size in found})
    for number, (name, found) in enumerate(values.items()):
        first = found[min(found)]
        if first > 0:
            ratios = [found[size] / first for size in sorted(found)]
            style = "o-" if number < len(palette.SERIES) else "s--"
            axes.plot(
                sorted(found),
                ratios,
                style,
                color=palette.SERIES[number % len(palette.SERIES)],
                markersize=4,
                label=name,
            )
    straight = [size / sizes[0] for size in sizes]
    axes.plot(sizes, straight, color=palette.RULE, linestyle=":", label="in proportion")
    axes.plot(sizes, [ratio**2 for ratio in straight], color=palette.LIMIT, linestyle=":", label="with the square")
    axes.set(xscale="log", yscale="log", xlabel="robots", ylabel=f"times what it is for {sizes[0]}", title=title)
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=120)
