"""The leaf ``age``: how old messages are by their own stamp when they arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.contents import ContentLeaf
from understudy.trees.evidence import Said
from understudy.trees.expressions import Fields
from understudy.trees.health import WatchedTopic
from understudy.trees.leaves import duration
from understudy.trees.observations import Content, Glance
from understudy.trees.plans import LeafKind, LeafPlan, hold_off_of, topic_of, type_of
from understudy.trees.reading import Reader, duration_of
from understudy.trees.situations import TaskActive

HEADER = "std_msgs/Header"


class AgeLeaf(ContentLeaf):
    """Holds while the newest message's stamp was at most so old when the message was received."""

    def __init__(
        self,
        path: str,
        topic: str,
        glance: Glance,
        most: float,
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """A leaf over a topic; ``most`` and ``hold_off`` in seconds."""
        super().__init__(path, topic, glance, hold_off=hold_off, tasks=tasks)
        self._most = most

    def said(self, content: Content, failed: bool) -> Said:
        """What the message says by its stamp."""
        age = content.age()
        if age is None:
            return Said(False, "it can't be told: there is no stamp")
        return Said(True, "") if age <= self._most else Said(False, f"it was {rounded(age)}")

    def condition(self) -> str:
        """The condition in words."""
        return f"an age of at most {duration(self._most)} of {self.topic}"


def rounded(seconds: float) -> str:
    """An age in words, such as ``412 ms`` or ``3.21 s``."""
    return f"{seconds * 1000:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s" if seconds < 1e6 else "over 11 days"


_EXAMPLE = "{topic: /scan, type: sensor_msgs/msg/LaserScan, most: 300ms}"


def _read(reader: Reader, value: Mapping[str, Any], path: str, fields: Fields | None) -> LeafPlan | None:
    before = len(reader.problems)
    topic = topic_of(reader, value, path, "/scan")
    type_ = type_of(reader, value, path)
    known = fields(type_) if type_ and fields is not None else None
    if known is not None and next(iter(known.values()), None) != HEADER:
        reader.problem(
            f"{path}.type", f"found {type_}, which doesn't begin with a header; an age needs one with a stamp"
        )
    if "most" not in value:
        reader.problem(f"{path}.most", "missing; give how old a message may be when it arrives, such as 300ms")
    most = reader.given(value, "most", path, duration_of)
    hold_off = hold_off_of(reader, value, path)
    if topic is None or most is None or len(reader.problems) > before:
        return None
    return LeafPlan(
        f"{topic.lstrip('/')}.age",
        WatchedTopic(topic, type_, 0.0, None, contents=1),
        lambda place, glance, tasks: AgeLeaf(place, topic, glance, most, hold_off=hold_off, tasks=tasks),
    )


AGE = LeafKind(("topic", "type", "most", "for"), _EXAMPLE, _read)
