"""Stacked bars of recovery times and CPU per strategy, like the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from understudy_demo.recovery import PARTS

from understudy.cli.common import palette
from understudy.cli.common.text.time_bars import NAMES


def recovery_times(
    parts: Mapping[str, Mapping[str, Sequence[float]]], path: Path, *, title: str, references: Mapping[str, float]
) -> None:
    """Draw the mean of each part of the recovery time per configuration, with a dot for every recovery.

    Args:
        parts: by configuration and part (detection, cluster, startup, reinitialization) the times in seconds.
        path: the file of the picture; its ending selects the format.
        references: horizontal lines for comparison in seconds, by label.
    """
    means = {
        configuration: {NAMES[part]: fmean(found[part]) for part in PARTS} for configuration, found in parts.items()
    }
    dots = {
        configuration: [sum(times) for times in zip(*(found[part] for part in PARTS), strict=True)]
        for configuration, found in parts.items()
    }
    colours = {NAMES[part]: palette.PARTS[part] for part in PARTS}
    _draw(means, colours, path, title=title, unit="seconds", digits=2, dots=dots, references=references)


def cpu(groups: Mapping[str, Mapping[str, float]], path: Path, *, title: str) -> None:
    """Draw the mean CPU per configuration, stacked by pod.

    Args:
        groups: by configuration and pod (or group of pods) the milli-CPU.
        path: the file of the picture; its ending selects the format.
    """
    names = list(dict.fromkeys(name for found in groups.values() for name in found))
    colours = {name: palette.SERIES[n % len(palette.SERIES)] for n, name in enumerate(names)}
    _draw(groups, colours, path, title=title, unit="milli-CPU", digits=0, dots={}, references={})


def _draw(
    bars: Mapping[str, Mapping[str, float]],
    colours: Mapping[str, str],
    path: Path,
    *,
    title: str,
    unit: str,
    digits: int,
    dots: Mapping[str, Sequence[float]],
    references: Mapping[str, float],
) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    figure, axes = plt.subplots(figsize=(3 + 1.7 * len(bars), 5.2), layout="constrained")
    for place, (configuration, layers) in enumerate(bars.items()):
        bottom = 0.0
        for name, colour in colours.items():
            height = layers.get(name, 0.0)
            axes.bar(place, height, 0.62, bottom=bottom, color=colour, label=name if place == 0 else None)
            bottom += height
        spread = dots.get(configuration, ())
        axes.plot([place + 0.38] * len(spread), spread, "o", color=palette.INK, markersize=3, alpha=0.6)
        top = max([bottom, *spread])
        axes.annotate(
            f"{bottom:.{digits}f}", (place, top), xytext=(0, 5), textcoords="offset points", ha="center", fontsize=10
        )
    for name, height in references.items():
        axes.axhline(height, color=palette.RULE, linewidth=1, linestyle="--")
        axes.annotate(name, (1, height), xycoords=("axes fraction", "data"), xytext=(-4, 3),
                      textcoords="offset points", ha="right", fontsize=8, color=palette.FAINT)  # fmt: skip
    axes.set_xticks(range(len(bars)), [name.replace(" ", "\n") for name in bars])
    axes.set_ylabel(unit)
    axes.set_title(title, loc="left", fontsize=11)
    axes.margins(y=0.12)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    known = {name: colour for name, colour in colours.items() if any(layers.get(name) for layers in bars.values())}
    handles = [Patch(color=colour) for colour in known.values()]
    figure.legend(handles, list(known), loc="outside right upper", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
