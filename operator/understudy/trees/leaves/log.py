"""The leaf ``log``: messages that nodes of the instance must not log, or not too often (rcl_interfaces/msg/Log on
``/rosout``)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import Leaf, LeafPlace, State, duration
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.core.task_activity import task_timing
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, node_key, time_key, word_key
from understudy.trees.source.value_reader import found_text, whole_number_of

TYPE = "rcl_interfaces/msg/Log"

TOPIC = "/rosout"

LEVELS = {"DEBUG": 10, "INFO": 20, "WARN": 30, "ERROR": 40, "FATAL": 50}
"""The numbers of the levels in rcl_interfaces/msg/Log, by name."""

LEVEL = 12
"""Offset of the level in a serialized message: after the CDR header and the stamp. For most messages, nothing more is
read."""

KEPT = 256
"""Greatest number of messages between two evaluations: all nodes share the topic."""

BURST = 1000.0
"""Expected messages per second."""

MOST = 1000
"""The greatest count that a tree may state."""

QUIET = 10.0
"""Seconds without such a message after which the leaf is healthy again, if the tree gives neither this time nor a
window."""

_LONGEST = 120
"""Most characters of a message in a reason."""


@dataclass(frozen=True)
class Pattern:
    """Selects the messages that count."""

    level: str | None = None
    """The lowest level that counts; None for any."""
    node: str | None = None
    """The node that logs it, fully qualified; None for any."""
    says: str | None = None
    """Text that it contains, in which ``*`` stands for any characters. The search takes a bounded time, because it
    looks for one part after the other."""

    def matched(self, content: Content) -> Any:
        """Return the message if it counts, else None. Raises Unreadable."""
        if self.level is not None and (content.byte(LEVEL) or 255) < LEVELS[self.level]:
            return None
        parts = [part for part in (self.says or "").split("*") if part]
        logger = self.node.strip("/").replace("/", ".") if self.node is not None else ""
        if not all(content.mentions(text) for text in (logger, *parts) if text):
            return None
        message: Any = content.message()
        try:
            level, name, text = message.level, message.name, message.msg
        except AttributeError:
            raise Unreadable(f"found a {type(message).__name__}, not a {TYPE}") from None
        if self.level is not None and level < LEVELS[self.level]:
            return None
        # A node's loggers are named after it, with dots in place of the slashes of its name and before their own parts.
        if logger and name != logger and not name.startswith(f"{logger}."):
            return None
        place = 0
        for part in parts:
            found = text.find(part, place)
            if found < 0:
                return None
            place = found + len(part)
        return message

    def __str__(self) -> str:
        of = f" of {self.level}{' or worse' if self.level != 'FATAL' else ''}" if self.level is not None else ""
        by = f" by node {self.node}" if self.node is not None else ""
        saying = f" with {self.says!r}" if self.says is not None else ""
        return f"{of}{by}{saying} on {TOPIC}"


@dataclass
class _LogRecord:
    """The messages that one instance has logged. Times are Unix seconds."""

    since: float
    """When the instance took control, which identifies it."""
    active: float = -math.inf
    """Since when messages count: the start of the task, if the leaf is for one."""
    last_evaluated: Content | None = None
    """The newest message that was evaluated."""
    received: float = 0.0
    """When that message was received, by the clock at that time."""
    times: deque[float] = field(default_factory=deque)
    """Times of receipt of the last messages that count."""
    first: float | None = None
    """When the first message of those that exceeded the count was received; None while the count is not exceeded."""
    last: float = -math.inf
    """When the last message that counts was received."""
    why: str = ""
    """The message with which the count was exceeded. The text stays the same while the failure lasts."""

    def shift(self) -> None:
        """Follow a step of the clock, which moved the time of the newest message."""
        if self.last_evaluated is None or self.last_evaluated.received == self.received:
            return
        step = self.last_evaluated.received - self.received
        self.received, self.last = self.last_evaluated.received, self.last + step
        self.active += step
        self.times = deque((time + step for time in self.times), self.times.maxlen)
        self.first = self.first + step if self.first is not None else None

    def begin(self, active: float) -> None:
        """Count from this time on."""
        self.active, self.first, self.last, self.why = active, None, -math.inf, ""
        self.times.clear()


class LogLeaf(Leaf):
    """Fails with the message that is the ``count``-th of its kind within ``window``, until none has arrived for
    ``quiet``.

    It need not wait for a first message: an instance that logs nothing of the kind is well. An instance that does so
    within its grace is starting until the grace ends.
    """

    def __init__(self, place: LeafPlace, pattern: Pattern, count: int, window: float, quiet: float) -> None:
        """Make a leaf over the messages of a pattern; ``window`` and ``quiet`` in seconds."""
        super().__init__(place, TOPIC)
        self._pattern, self._count, self._window, self._quiet = pattern, count, window, quiet
        self._track = _LogRecord(math.nan)

    # -- logged messages --------------------------------------------------------------------------------------------

    def _followed(self) -> _LogRecord:
        """Return what was logged up to the time of the evaluation. Each message is evaluated once."""
        evaluation, track = self._evaluation, self._track
        if track.since != evaluation.since:
            track = self._track = _LogRecord(evaluation.since, times=deque(maxlen=self._count))
        track.shift()
        found = task_timing(self.tasks, evaluation)
        # The leaf's clock starts with the task: messages that were logged while the task was not active do not count.
        active = found.active if found is not None else math.inf
        if abs(track.active - active) > 1e-3:
            track.begin(active)
        for content in self._fresh(track):
            if content.received >= active:
                self._note(track, content)
            track.last_evaluated, track.received = content, content.received
        return track

    def _fresh(self, track: _LogRecord) -> list[Content]:
        record = self._evaluation.observations.own(self.topic)
        found: list[Content] = []
        for content in reversed(record.contents if record is not None else ()):
            if content is track.last_evaluated or content.received < self._evaluation.since:
                break
            found.append(content)
        return found[::-1]

    def _note(self, track: _LogRecord, content: Content) -> None:
        try:
            message = self._pattern.matched(content)
        except Unreadable:
            return  # a message that cannot be read does not count
        if message is None:
            return
        if track.first is not None and content.received >= track.last + self._quiet:
            track.begin(track.active)  # the leaf was healthy again in between
        track.last = content.received
        track.times.append(content.received)
        # The window is open at its end: as many messages in exactly a window's length are too many, like a gap of
        # exactly its limit.
        if track.first is not None or len(track.times) < self._count:
            return
        if self._count == 1 or track.times[-1] - track.times[0] < self._window:
            track.first, track.why = track.times[0], _message_text(message)

    # -- the state --------------------------------------------------------------------------------------------------

    def _limits(self) -> tuple[float, float, float]:
        """Return when the messages end the leaf's health, when it fails, and when it is healthy again; infinite for
        never."""
        track, evaluation = self._followed(), self._evaluation
        if track.first is None:
            return math.inf, math.inf, math.inf
        found = task_timing(self.tasks, evaluation)
        settled = found.settled if found is not None and self.tasks else -math.inf
        return settled, max(settled, evaluation.in_time), track.last + self._quiet

    def state(self) -> State:
        """Return the state at the time of the evaluation."""
        begins, fails, ends = self._limits()
        now = self._evaluation.now
        if now < begins or now >= ends:
            return "Healthy"
        return "Starting" if now < fails else "Failed"

    def healthy_until(self) -> float | None:
        """Return when the leaf stops being healthy; None if it is not healthy. Another message can arrive at any time."""
        begins, _, ends = self._limits()
        now = self._evaluation.now
        if now >= ends:
            return math.inf
        if now >= begins:
            return None
        return begins if begins < ends else math.inf

    def changes(self) -> list[float]:
        """Return the times after the evaluation at which the state may change without a further message."""
        return [moment for moment in self._limits() if self._evaluation.now < moment < math.inf]

    def last(self) -> float | None:
        """Return the last good time: when the first of the messages that exceeded the count was received."""
        return self._followed().first

    def _plain_reason(self, state: State) -> str:
        few = self._count == 1
        if state == "Healthy":
            return f"no message{self._pattern}" if few else f"fewer than {self._count} messages{self._pattern}"
        what = "a message" if few else f"{self._count} messages within {duration(self._window)}"
        still = ", while it may still be starting" if state == "Starting" else ""
        return f"{what}{self._pattern}{still} ({self._followed().why})"


def _message_text(message: Any) -> str:
    level = next((name for name, number in LEVELS.items() if number == message.level), f"level {message.level}")
    text = " ".join(message.msg.split())
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
    return f"{message.name[:_LONGEST]} says {level}: {text}"


def _check(values: LeafValues) -> None:
    if not any(key in values for key in ("level", "node", "says")):
        values.problem("", f"none of level, node and says is given; say which messages count, such as {_EXAMPLE}")
    count = values["count"]
    if count is not None and count > 1 and "window" not in values:
        values.problem("window", f"missing; give the time within which {count} messages are too many")
    if count == 1 and "window" in values:
        values.problem("window", "a window is only for a count above 1; give count, or remove window")


def _plan(values: LeafValues) -> LeafPlan:
    node, count, window = values["node"], values["count"], values["window"] or 0.0
    pattern, quiet = Pattern(values["level"], node, values["says"]), values["quiet"] or window or QUIET
    return LeafPlan(
        f"{node.lstrip('/')}.log" if node is not None else "log",
        WatchedTopic(TOPIC, TYPE, 0.0, BURST, contents=KEPT, whole=True, prompt=True),
        lambda place: LogLeaf(place, pattern, count, window, quiet),
    )


def _says(found: object) -> str:
    if not isinstance(found, str) or not found.strip("* ") or len(found) > 256:
        raise ValueError(
            f"found {found_text(found)}; give text of up to 256 characters that is in the message, such as "
            "'Failed to make progress', where * stands for any characters"
        )
    return found


_EXAMPLE = "{level: ERROR, node: /controller_server}"

LOG = LeafKind(
    "log",
    "while nodes do not log what they should not",
    (
        word_key(
            "level", "the least severe level that counts: DEBUG, INFO, WARN, ERROR or FATAL", "severity", tuple(LEVELS)
        ),
        node_key("the node that logs it, such as /controller_server", required=False),
        Key("says", "text that the message contains; * stands for any characters", read=_says),
        Key(
            "count",
            "the number of messages that is too many, such as 3",
            "int",
            default="1",
            read=whole_number_of(MOST),
        ),
        time_key("window", "the time within which they are too many, such as 20s"),
        time_key("quiet", "the time without such a message after which the leaf holds again, such as 1m"),
    ),
    _EXAMPLE,
    _plan,
    _check,
)
