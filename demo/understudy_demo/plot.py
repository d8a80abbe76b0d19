"""The demo's picture: commands per source and the robot's speed over time, the recoveries shaded in their parts."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from understudy.cli.common import palette
from understudy.cli.common.text.time_bars import NAMES, length, short
from understudy_demo.recovery import PARTS, Recovered
from understudy_demo.robotview import RobotLog


def draw(log: RobotLog, recoveries: Sequence[Recovered], path: Path, *, title: str) -> None:
    """Write the picture: the whole run above, each recovery magnified below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    shown = [r for r in recoveries if r.start is not None]
    sources = log.sources()
    colours = {source: palette.SERIES[n % len(palette.SERIES)] for n, source in enumerate(sources)}
    columns = max(1, len(shown))
    figure = plt.figure(figsize=(5.4 * columns, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, columns, height_ratios=(1.0, 1.25, 0.9))
    figure.suptitle(title, fontsize=13)

    whole = figure.add_subplot(grid[0, :])
    starts = [c.received for c in log.commands[:1]] + [r.start for r in shown if r.start is not None]
    origin = min(starts, default=0.0)
    _commands(whole, log, sources, colours, origin, size=5)
    for recovered in shown:
        _shade(whole, recovered, origin)
        assert recovered.start is not None
        whole.annotate(
            f"#{recovered.number}",
            (recovered.start - origin, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(-3, 4),
            textcoords="offset points",
            ha="right",
        )
    whole.set_xlabel("seconds since the first command")
    whole.set_title("commands that reached the robot, by the pod that sent them", loc="left", fontsize=10)

    for column, recovered in enumerate(shown):
        assert recovered.start is not None
        total = sum(recovered.parts.values())
        handover = recovered.handover(log)
        end = max(total, (handover.first_new or recovered.start) - recovered.start)
        span = (-0.25 * end - 0.3, 1.25 * end + 0.3)
        part = log.between(recovered.start + span[0], recovered.start + span[1])
        names = [source for source in sources if source in part.times() or source in (recovered.old, recovered.new)]
        above = figure.add_subplot(grid[1, column])
        below = figure.add_subplot(grid[2, column], sharex=above)
        _commands(above, part, names, colours, recovered.start, size=9)
        below.plot([m.time - recovered.start for m in part.motions], [m.speed for m in part.motions], color=palette.INK)
        for axes in (above, below):
            _shade(axes, recovered, recovered.start)
        above.set_xlim(*span)
        above.tick_params(labelbottom=False)
        gap = "" if handover.gap is None else f", robot without commands for {length(handover.gap)}"
        above.set_title(f"#{recovered.number} {recovered.strategy}: {length(total)}{gap}", loc="left", fontsize=10)
        below.set_ylim(-0.03, max([0.6, *(m.speed for m in part.motions)]) * 1.05)
        below.set_xlabel("seconds since the last healthy output")
        if column == 0:
            below.set_ylabel("robot's speed, m/s")
    figure.legend(
        handles=[Patch(color=palette.PARTS[part], alpha=0.55, label=NAMES[part]) for part in PARTS],
        loc="outside lower center",
        ncols=len(PARTS),
        frameon=False,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _commands(
    axes: Any, log: RobotLog, sources: Sequence[str], colours: dict[str, str], origin: float, *, size: int
) -> None:
    times = log.times()
    for row, source in enumerate(sources):
        arrived = [moment - origin for moment in times.get(source, [])]
        axes.plot(arrived, [row] * len(arrived), "|", color=colours[source], markersize=size, markeredgewidth=0.9)
    names = short(sources)
    axes.set_yticks(range(len(sources)), [names[source] for source in sources], fontsize=8)
    axes.set_ylim(len(sources) - 0.4, -0.6)
    axes.grid(axis="x", color=palette.GRID, linewidth=0.5)
    axes.set_axisbelow(True)


def _shade(axes: Any, recovered: Recovered, origin: float) -> None:
    assert recovered.start is not None
    begin = recovered.start - origin
    for part in PARTS:
        seconds = recovered.parts.get(part, 0.0)
        if seconds > 0:
            axes.axvspan(begin, begin + seconds, color=palette.PARTS[part], alpha=0.45, linewidth=0)
        begin += seconds


def taken(log: RobotLog) -> str:
    """When the log was taken, for titles."""
    if not log.commands:
        return ""
    return datetime.fromtimestamp(log.commands[0].received).strftime("%Y-%m-%d %H:%M")
