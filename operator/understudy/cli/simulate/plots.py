"""Draws the evaluation of a policy over a bag: one lane per leaf, over time."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

from understudy.cli.common import palette, plot_files
from understudy.cli.simulate.leaf_history import Failure, Span
from understudy.cli.simulate.replay import Replay
from understudy.trees.core.leaf import duration

WIDTH, LANE, REST, DOTS = 12.0, 0.55, 1.75, 150
"""The width of the picture, the height of a lane, the height around the lanes (all in inches), and dots per inch."""

COLOURS = {
    **{state: palette.pale(palette.STATES[state], 0.45) for state in ("Healthy", "Starting", "Failed")},
    **dict.fromkeys(("Idle", "Unasked"), palette.pale(palette.GREY, 0.12)),
}
_WORDS = {
    "Healthy": "healthy",
    "Starting": "starting",
    "Failed": "failed",
    "Idle": "not evaluated",
    "Unasked": "not evaluated",
}
_LONGEST = 34
"""Most characters of a leaf's path next to its lane."""


def draw(file: str, title: str, replay: Replay, start: float, end: float, onsets: Sequence[float] = ()) -> None:
    """Draw the picture into a file. Times are unix seconds. Raises CommandError if it cannot be written."""
    evaluation = replay.evaluation
    lanes = list(replay.topics.items())
    height = REST + LANE * (len(lanes) + 1)
    axes = plot_files.axes(WIDTH, height, grid="x", hidden=("top", "right", "left"), dpi=DOTS)
    length = max(end - start, 1e-3)
    _bands(axes, 0, evaluation.spans[""], start, 0.7)
    for row, (path, _) in enumerate(lanes, 1):
        _bands(axes, row, evaluation.spans[path], start, 0.7)
        _messages(axes, row, replay.received(path), start, length)
    _marks(axes, evaluation.failures, onsets, start, length, len(lanes))
    axes.set_yticks(range(len(lanes) + 1), ["whole tree", *(_lane(path, topic) for path, topic in lanes)])
    axes.get_yticklabels()[0].set_fontweight("bold")
    axes.set_ylim(len(lanes) + 0.6, -0.6)
    axes.set_xlim(-0.01 * length, 1.01 * length)
    axes.set_xlabel("seconds from the start of the bag")
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", pad=24)
    axes.tick_params(axis="y", length=0)
    axes.figure.legend(
        handles=list(_legend(evaluation.spans, bool(evaluation.detections), bool(onsets))),
        loc="outside lower center",
        ncols=7,
        frameon=False,
        fontsize=8.5,
    )
    plot_files.save(axes, file)


def _bands(axes: Any, row: int, spans: Sequence[Span], start: float, height: float) -> None:
    """Draw the states of a leaf."""
    for span in spans:
        ended = span.ended if span.ended is not None else span.started
        axes.broken_barh(
            [(span.started - start, ended - span.started)],
            (row - height / 2, height),
            facecolors=COLOURS[span.state],
            edgecolors=COLOURS[span.state],
            linewidth=0.4,
        )


def _messages(axes: Any, row: int, times: array[float], start: float, length: float) -> None:
    """Draw a tick per message as far as the resolution allows: dense messages become a bar, and gaps stay visible."""
    dot = length / (WIDTH * DOTS)
    shown: list[float] = []
    for moment in times:
        if not shown or moment - start - shown[-1] >= dot:
            shown.append(moment - start)
    axes.vlines(shown, row + 0.08, row + 0.3, color=palette.INK, linewidth=72 / DOTS)
    gaps = [(one, later) for one, later in pairwise([start, *times, start + length]) if later - one > length / 25]
    for begin, ended in sorted(gaps, key=lambda gap: gap[0] - gap[1])[:4]:
        middle = (begin + ended) / 2 - start
        words = f"{duration(float(f'{ended - begin:.3g}'))} without"
        axes.annotate(
            words if ended - begin > length / 8 else words.removesuffix(" without"),
            (middle, row + 0.19),
            ha="center",
            va="center",
            fontsize=7,
            color=palette.FAINT,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0},
            zorder=5,
        )


def _marks(
    axes: Any, failures: Sequence[Failure], onsets: Sequence[float], start: float, length: float, lanes: int
) -> None:
    """Draw lines at detections and given onsets."""
    for onset in onsets:
        axes.axvline(onset - start, color=palette.BLUE, linewidth=1.2, linestyle=(0, (4, 3)))
    free = -length
    for one in failures:
        if one.detected is None:
            continue
        at = one.detected - start
        axes.axvline(at, color=palette.LIMIT, linewidth=1.4)
        if at - free > length * 0.07:  # leave room for the previous label
            axes.annotate(
                f"{at:.3f} s",
                (at, -0.6),
                xytext=(0, 4),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=8,
                color=palette.LIMIT,
                annotation_clip=False,
            )
            free = at


def _legend(spans: dict[str, list[Span]], detected: bool, onsets: bool) -> Iterator[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    states = {span.state for one in spans.values() for span in one}
    words = {_WORDS[state]: COLOURS[state] for state in COLOURS if state in states}
    for word, colour in words.items():
        yield Patch(facecolor=colour, label=word)
    yield Line2D([], [], color=palette.INK, marker="|", linestyle="none", markersize=8, label="message")
    if detected:
        yield Line2D([], [], color=palette.LIMIT, linewidth=1.4, label="detected")
    if onsets:
        yield Line2D([], [], color=palette.BLUE, linewidth=1.2, linestyle=(0, (4, 3)), label="given onset")


def _lane(path: str, topic: str) -> str:
    shown = path if len(path) <= _LONGEST else f"…{path[1 - _LONGEST :]}"
    return (
        shown
        if topic.lstrip("/") == path
        else f"{shown}\n{topic if len(topic) <= _LONGEST else f'…{topic[1 - _LONGEST :]}'}"
    )
