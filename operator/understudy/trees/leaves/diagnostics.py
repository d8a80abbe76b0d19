"""The leaf ``diagnostics``: the worst level that statuses on ``/diagnostics`` may have (REP 107)."""

from __future__ import annotations

from typing import Any, NamedTuple

from understudy.trees.core.evidence import Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.leaves.leaf_plan import (
    Key,
    LeafKind,
    LeafPlan,
    LeafValues,
    fails_on_arrival,
    time_key,
    topic_key,
    word_key,
)
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.value_reader import found_text

TYPE = "diagnostic_msgs/msg/DiagnosticArray"

TOPIC = "/diagnostics"

OWN = "understudy: "
"""Prefix of the statuses that monitors publish there themselves (docs/ros-tools.md). They are judgements, not evidence:
a tree that used them would judge itself, or would take another instance's failure for its own."""

LEVELS = ("OK", "WARN", "ERROR", "STALE")
"""The levels in the order of their numbers in diagnostic_msgs/msg/DiagnosticStatus."""

KEPT = 64
"""Greatest number of messages between two evaluations: each node publishes its own, and none may be lost."""

BURST = 250.0
"""Expected messages per second: many nodes may publish at the same time."""

MOST_STATUSES = 512
"""Greatest number of statuses that are remembered: a node that invents names without end must not fill the memory."""

_LONGEST = 120
"""Most characters of a status's own message in a reason."""


class _Level(NamedTuple):
    """The last level of a status."""

    level: int
    text: str
    well: bool
    """Whether its level has ever been allowed."""


class DiagnosticsLeaf(ContentLeaf):
    """Holds while the last level of each status with a name, or with a name that begins with a prefix, is at most
    ``worst``."""

    every = True

    def __init__(
        self, place: LeafPlace, topic: str, hold_off: float, name: str | None, prefix: str, worst: int
    ) -> None:
        """Make a leaf over the statuses named ``name``, or else all with names that begin with ``prefix``; ``hold_off``
        in seconds."""
        super().__init__(place, topic, hold_off)
        self._name, self._prefix, self._worst = name, prefix, worst
        self._levels: dict[str, _Level] = {}

    def forget(self) -> None:
        """Forget the levels."""
        self._levels.clear()

    def evaluate(self, content: Content, failed: bool) -> Finding | None:
        """Evaluate all statuses including those of this message; None if the message has none of them."""
        try:
            found = [status for status in _statuses(content.message()) if self._asked(status[0])]
        except Unreadable as error:
            return Finding(False, f"{self.topic} cannot be judged: {error}")
        if not found:
            return None
        for name, level, text in found:
            before = self._levels.pop(name, None)  # so that the oldest one comes first
            well = level <= self._worst or (before is not None and before.well)
            self._levels[name] = _Level(level, text, well)
        while len(self._levels) > MOST_STATUSES:
            del self._levels[next(iter(self._levels))]
        bad = {name: status for name, status in self._levels.items() if status.level > self._worst}
        if not bad:
            return Finding(True, "")
        name = max(bad, key=lambda name: bad[name].level)
        more = f", and {len(bad) - 1} more" if len(bad) > 1 else ""
        # Nodes start one after the other: the grace of the others does not end when the first are well.
        starting = content.received < self._evaluation.in_time and not any(status.well for status in bad.values())
        return Finding(False, f"{self.topic}: {_status_text(name, bad[name].level, bad[name].text)}{more}", starting)

    def _asked(self, name: str) -> bool:
        if name.startswith(OWN) or f"/{OWN}" in name:  # diagnostic_aggregator puts a path before the name
            return False
        return name == self._name if self._name is not None else name.startswith(self._prefix)

    def condition(self) -> str:
        """Return the condition in words."""
        return f"a level of at most {LEVELS[self._worst]} of {self.awaited()}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"at most {LEVELS[self._worst]} is required"

    def awaited(self) -> str:
        """Return the statuses that must arrive."""
        if self._name is not None:
            return f"status {self._name!r} on {self.topic}"
        return f"status {self._prefix + '...'!r} on {self.topic}" if self._prefix else f"status on {self.topic}"


def _statuses(message: Any) -> list[tuple[str, int, str]]:
    """Return name, level and text of each status of a message. Raises Unreadable."""
    try:
        return [(str(s.name), _level(s.level), str(s.message)) for s in message.status]
    except (AttributeError, TypeError):
        raise Unreadable(f"found a {type(message).__name__}, not a {TYPE}") from None


def _level(level: bytes | int) -> int:
    return level[0] if isinstance(level, bytes) else level


def _status_text(name: str, level: int, text: str) -> str:
    word = LEVELS[level] if level < len(LEVELS) else f"level {level}"
    text = " ".join(text.split())
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
    return f"status {name[:_LONGEST]!r} is {word}{f' ({text})' if text else ''}"


def _check(values: LeafValues) -> None:
    for key in ("name", "prefix"):
        text = values[key]
        if text is not None and text.startswith(OWN.rstrip()):
            values.problem(
                key,
                f"found {text!r}: Understudy's own status is no evidence; give a status of the application or of the robot",
            )
    if "name" in values and "prefix" in values:
        values.problem("prefix", "found name and prefix; give the whole name, or what the names begin with")


def _plan(values: LeafValues) -> LeafPlan:
    topic, hold_off, worst = values["topic"], values.hold_off, LEVELS.index(values["worst"])
    name, prefix = values["name"], values["prefix"] or ""
    return LeafPlan(
        topic.lstrip("/"),
        WatchedTopic(topic, TYPE, 0.0, BURST, contents=KEPT, whole=True, prompt=fails_on_arrival(hold_off)),
        lambda place: DiagnosticsLeaf(place, topic, hold_off, name, prefix, worst),
    )


def _text(found: object) -> str:
    if not isinstance(found, str) or not found or len(found) > 256:
        raise ValueError(f"found {found_text(found)}; give text of up to 256 characters, such as 'camera: driver'")
    return found


DIAGNOSTICS = LeafKind(
    "diagnostics",
    "while no status on /diagnostics is worse than allowed",
    (
        topic_key("", "/diagnostics, or another topic of its type", default=TOPIC),
        Key("name", "the name of the status", xml="status", read=_text),
        Key("prefix", "the beginning of the names of the statuses", read=_text),
        word_key(
            "worst",
            "the worst level that is allowed: OK, WARN or ERROR",
            "level",
            LEVELS[:3],
            missing="give the worst level that is allowed: OK, WARN or ERROR",
        ),
        time_key("for", "how long a level may be worse before that is a failure, such as 2s"),
    ),
    '{name: "camera: driver", worst: WARN}',
    _plan,
    _check,
)
