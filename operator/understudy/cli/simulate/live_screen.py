"""Displays a live tree: as a screen that is redrawn, or as one line per change."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TextIO

from understudy.api.plain_text import plain
from understudy.cli.common.text import terminal
from understudy.cli.common.text.tree_text import WORDS, Rates, coloured, rough, tree_lines
from understudy.cli.common.text.wording import wall
from understudy.cli.simulate.leaf_history import Evaluation, Failure
from understudy.trees.core.observations import Observations
from understudy.trees.core.snapshots import Shown, snapshot

PERIOD = 0.5
"""Seconds between two updates if only figures change."""

COUNTED = 2.0
"""Seconds over which rates are measured; over less, the rates of slow topics would jump."""


class Lines:
    """Prints one line per change."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._shown: dict[str, int] = {}
        self._notes: set[str] = set()
        self._detected = 0

    def show(self, evaluation: Evaluation, observations: Observations, now: float, notes: Sequence[str]) -> None:
        """Print the changes until ``now`` (unix seconds); ``notes`` say what is not watched and why."""
        for note in notes:
            if note not in self._notes:
                self._line(now, note)
        self._notes = set(notes)
        for path, spans in sorted(evaluation.spans.items()):
            for span in spans[self._shown.get(path, 0) :]:
                why = f": {span.reason}" if span.reason else ""
                self._line(span.started, f"{path or 'the tree'} is {WORDS[span.state]}{why}")
            self._shown[path] = len(spans)
        for failure in evaluation.detections[self._detected :]:
            self._line(failure.detected or now, f"DETECTED {failure.leaf}: {failure.reason}")
        self._detected = len(evaluation.detections)

    def close(self) -> None:
        """Do nothing."""

    def _line(self, moment: float, text: str) -> None:
        print(wall(moment), plain(text), file=self._out, flush=True)


class Screen:
    """Redraws the whole tree in a terminal."""

    def __init__(self, out: TextIO, title: str) -> None:
        self._out, self._title = out, title
        self._drawn = self._counted = 0.0
        self._before: list[Shown] = []
        self._rates = Rates()
        terminal.begin(out)

    def show(self, evaluation: Evaluation, observations: Observations, now: float, notes: Sequence[str]) -> None:
        """Redraw at once after a change, and else twice a second for the figures."""
        states: list[Shown] = [spans[-1].state for spans in evaluation.spans.values()]
        if states == self._before and now - self._drawn < PERIOD:
            return
        self._before, self._drawn = states, now
        tree = snapshot(evaluation.tree, observations, now)
        if now - self._counted >= COUNTED:
            self._counted = now
            self._rates.update({"tree": tree, "time": now})
        lines = [plain(self._title), *_summary(evaluation, now), "", *tree_lines(tree, self._rates, colours=True)]
        lines += ["", *(plain(note) for note in notes)] if notes else []
        terminal.draw(self._out, lines)

    def close(self) -> None:
        """Restore the terminal."""
        terminal.end(self._out)


Display = Lines | Screen


def _summary(evaluation: Evaluation, now: float) -> Iterator[str]:
    span = evaluation.spans[""][-1]
    why = f": {plain(span.reason)}" if span.reason else ""
    yield f"{coloured(WORDS[span.state], span.state, colours=True)} for {rough(now - span.started)}{why}"
    failures, watched = evaluation.detections, rough(now - evaluation.since)
    if failures:
        count = f"{len(failures)} {'failure' if len(failures) == 1 else 'failures'}"
        yield f"{count} in {watched}; the last one: {describe(failures[-1])}"
    else:
        yield f"no failure in {watched}"


def describe(failure: Failure) -> str:
    """Describe a failure in one line."""
    return f"{wall(failure.detected or failure.failed)} {failure.leaf}: {plain(failure.reason)}"
