"""Formats a live health tree as lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from understudy.api.plain_text import plain
from understudy.cli.common import palette

WORDS = {"Healthy": "healthy", "Starting": "starting", "Failed": "FAILED", "Idle": "idle", "Unasked": "not evaluated"}


@dataclass
class Rates:
    """Message rates of topics, from the monitor's counters in successive states."""

    _before: dict[str, tuple[int, float]] = field(default_factory=dict)
    _rates: dict[str, float] = field(default_factory=dict)

    def update(self, state: Mapping[str, Any]) -> None:
        """Add a state of the monitor."""
        for path, node in _nodes(state.get("tree")):
            if "received" not in node:
                continue
            count, now = node["received"], state["time"]
            before = self._before.get(path)
            if before is not None and now <= before[1]:
                continue
            if before is not None and count >= before[0]:
                self._rates[path] = (count - before[0]) / (now - before[1])
            else:
                self._rates.pop(path, None)
            self._before[path] = (count, now)

    def of(self, path: str) -> float | None:
        """Return the messages per second of a leaf's topic between the last two states; None before there are two."""
        return self._rates.get(path)


def lines(state: Mapping[str, Any], rates: Rates, *, colours: bool) -> Iterator[str]:
    """Format the state of a monitor for a terminal."""

    health = coloured(plain(state["health"]), state["health"], colours=colours)
    yield f"{plain(state['namespace'])}/{plain(state['workload'])}  {health}"
    yield (
        f"active instance: {plain(state['active']) or 'none'} (epoch {state['epoch']}); policy {plain(state['policy']) or 'none'}; "
        f"next strategy: {plain(state['strategy']) or 'unknown'}; recoveries: {state['recoveries']}"
    )
    for condition in state.get("conditions", ()):
        if condition["type"] == "Degraded" and condition["status"] == "True":
            yield f"degraded: {plain(condition['message'])}"
    yield ""
    yield from tree_lines(state.get("tree"), rates, colours=colours)
    notes = [plain(note) for note in state["notes"]]
    if notes:
        yield ""
        yield from notes


def tree_lines(tree: Mapping[str, Any] | None, rates: Rates, *, colours: bool) -> Iterator[str]:
    """Format a snapshot of a tree with a line for each node: its state, the rate of its topic, and why it is not healthy."""
    nodes = list(_nodes(tree))
    if not nodes:
        yield "There is no health tree to evaluate."
    width = max((2 * path.count("/") + len(_label(node)) for path, node in nodes), default=0)
    for path, node in nodes:
        label = f"{'  ' * path.count('/')}{_label(node)}".ljust(width)
        word = coloured(WORDS[node["state"]].ljust(9), node["state"], colours=colours)
        figures = _figures(node, rates.of(path))
        yield f"{label}  {word}  {figures:22}  {plain(node['reason'])}".rstrip()


def coloured(text: str, state: str, *, colours: bool) -> str:
    """Return a text in the colour of a state."""
    return f"\x1b[{palette.TERMINAL.get(state, palette.TERMINAL_FAINT)}m{text}\x1b[0m" if colours else text


def rough(seconds: float) -> str:
    """Format a duration roughly."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds:.0f} s"


def _nodes(node: Mapping[str, Any] | None, path: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    if node is None:
        return
    yield path, node
    for index, child in enumerate(node.get("children", ())):
        yield from _nodes(child, f"{path}/{index}")


def _label(node: Mapping[str, Any]) -> str:
    name, kind = plain(node["name"]), plain(node["kind"])
    if node.get("task"):
        return f"{name} (while {plain(node['task'])} is active)"
    return name if kind in (name, "topic") else f"{name} ({kind})"


def _figures(node: Mapping[str, Any], rate: float | None) -> str:
    if node.get("age") is None:
        return ""
    often = f"{rate:.3g} Hz, " if rate is not None else ""
    return f"{often}{rough(node['age'])} ago"
