"""The leaf ``transform``: whether a transform between two frames is received, and is not too old when it arrives
(tf2)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

from understudy.trees.core.evidence import EvidenceTrack, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace, State, duration
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.leaves.age import rounded
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, fails_on_arrival, time_key, topic_key
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.value_reader import found_text

TYPE = "tf2_msgs/msg/TFMessage"

TOPIC = "/tf"

STATIC = "tf_static"

KEPT = 256
"""Greatest number of messages between two evaluations: all frames share the topic, and the frames of the leaf may be
rare among them."""

BURST = 1000.0
"""Expected messages per second."""

_FRAME = re.compile(r"[^\s/]\S{0,255}")


class TransformLeaf(ContentLeaf):
    """Holds while a transform is received: failed if no message of the topic has contained it for ``gap`` seconds.

    With ``most``, it also fails because of a transform that was older than that, by its own stamp, when it was
    received.
    """

    every = True

    def __init__(
        self,
        place: LeafPlace,
        topic: str,
        hold_off: float,
        frames: tuple[str | None, str],
        gap: float,
        most: float | None,
    ) -> None:
        """Make a leaf over the transform between two frames: from any parent, if the first is None. Times in
        seconds."""
        super().__init__(place, topic, hold_off)
        self._parent, self._child = frames
        self._gap, self._most = gap, most

    def evaluate(self, content: Content, failed: bool) -> Finding | None:
        """Evaluate the message; None if the transform is not in it."""
        if not content.mentions(self._child):
            return None
        stamps = list(self._stamps(content))
        if not stamps:
            return None
        if self._most is None:
            return Finding(True, "")
        newest = max(stamps)
        if not newest:
            return Finding(False, f"the age of {self.awaited()} cannot be determined: it has no stamp")
        age = content.older(newest)
        if age <= self._most:
            return Finding(True, "")
        return Finding(False, f"{self.awaited()} arrived with an age of {rounded(age)}")

    def _stamps(self, content: Content) -> Iterator[float]:
        """Return the stamps of the transform in a message, in Unix seconds."""
        try:
            transforms: Any = getattr(content.message(), "transforms", ())
        except Unreadable:
            return  # a message that cannot be read contains no usable transform
        for one in transforms:
            # tf2 treats a frame with a leading slash like the one without.
            same = one.child_frame_id.removeprefix("/") == self._child
            if same and self._parent in (None, one.header.frame_id.removeprefix("/")):
                stamp = one.header.stamp
                yield stamp.sec + stamp.nanosec * 1e-9

    def lost(self, track: EvidenceTrack[Content]) -> float:
        """Return when the leaf fails if nothing more arrives: because of the gap or the age."""
        return min(super().lost(track), self._silent(track))

    def _silent(self, track: EvidenceTrack[Content]) -> float:
        """Return when the gap is exceeded if nothing more arrives."""
        return max(track.last_finding if track.last_finding is not None else -math.inf, self.clocks_start()) + self._gap

    def condition(self) -> str:
        """Return the condition in words."""
        if self._most is None:
            return self.awaited()
        return f"an age of at most {duration(self._most)} of {self.awaited()}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return super().requirement() if self._most is None else f"at most {duration(self._most)} is required"

    def awaited(self) -> str:
        """Return the transform that must arrive."""
        frames = f"{self._parent} -> {self._child}" if self._parent is not None else f"to {self._child}"
        return f"transform {frames} on {self.topic}"

    def _plain_reason(self, state: State) -> str:
        track = self.followed()
        if (
            state == "Failed"
            and track.last_finding is not None
            and track.held
            and self._evaluation.now >= self._silent(track)
        ):
            return f"no {self.awaited()} for {duration(self._gap)}"
        if state == "Healthy" and track.last_finding is not None:
            return f"{self.awaited()} is received"
        return super()._plain_reason(state)


def _check(values: LeafValues) -> None:
    topic, child, parent = values["topic"], values["child"], values["parent"]
    if topic is not None and topic.rsplit("/", 1)[-1] == STATIC:
        values.problem("topic", f"found {topic!r}: static transforms are published once, without a gap; give {TOPIC}")
    if child is not None and child == parent:
        values.problem("parent", f"found {parent!r}, which is also the child; give its parent frame, such as odom")
    if "for" in values and "at_most" not in values:
        values.problem(
            "for",
            "it is allowed only with at_most; give at_most, or remove 'for'. The key gap sets how long the transform may be missing",
        )


def _plan(values: LeafValues) -> LeafPlan:
    topic, hold_off, frames = values["topic"], values.hold_off, (values["parent"], values["child"])
    gap, most = values["gap"], values["at_most"]
    prompt = most is not None and fails_on_arrival(hold_off)
    return LeafPlan(
        f"{values['child']}.transform",
        WatchedTopic(topic, TYPE, 0.0, BURST, contents=KEPT, whole=True, prompt=prompt),
        lambda place: TransformLeaf(place, topic, hold_off, frames, gap, most),
    )


def _frame(found: object) -> str:
    if not isinstance(found, str) or not _FRAME.fullmatch(found):
        if isinstance(found, str) and _FRAME.fullmatch(bare := found.removeprefix("/")):
            raise ValueError(f"found {found_text(found)}; frames have no slash in front, did you mean {bare!r}?")
        raise ValueError(f"found {found_text(found)}; give a frame's name without spaces, such as base_link")
    return found


TRANSFORM = LeafKind(
    "transform",
    "while a transform between two frames is received",
    (
        topic_key("", "/tf, or another topic of its type", default=TOPIC),
        Key(
            "child",
            "the child frame of the transform (child_frame_id), such as base_link",
            read=_frame,
            missing="give the child frame of the transform, such as base_link",
        ),
        Key("parent", "the parent frame of the transform (header.frame_id), such as odom", read=_frame),
        time_key(
            "gap", "how long it may be missing, such as 500ms", missing="give how long it may be missing, such as 500ms"
        ),
        time_key("at_most", "the greatest age of the transform when it arrives, such as 300ms"),
        time_key("for", "how long it may be older before that is a failure, such as 1s"),
    ),
    "{parent: odom, child: base_link, gap: 500ms}",
    _plan,
    _check,
)
