"""The leaf ``age``: how old messages are when they arrive, by their own stamp or by the time at which their writer sent
them."""

from __future__ import annotations

from understudy.trees.core.evidence import Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace, duration
from understudy.trees.core.observations import Content
from understudy.trees.leaves.leaf_plan import (
    TYPE,
    LeafKind,
    LeafPlan,
    LeafValues,
    fails_on_arrival,
    time_key,
    topic_key,
    word_key,
)
from understudy.trees.leaves.message_content import ContentLeaf

HEADER = "std_msgs/Header"

STAMP, SOURCE = "stamp", "source"

CLOCKS = (STAMP, SOURCE)
"""What an age can be measured from: the stamp of the message's header, or the source timestamp that DDS sends with
every sample (OMG DDS 1.4, 2.2.2.5.5; ``source_timestamp`` of ``rmw_message_info_t``)."""


class AgeLeaf(ContentLeaf):
    """Holds while the newest message was not too old when it was received."""

    def __init__(self, place: LeafPlace, topic: str, hold_off: float, most: float, by: str) -> None:
        """Make a leaf over a topic; ``most`` and ``hold_off`` in seconds, ``by`` one of CLOCKS."""
        super().__init__(place, topic, hold_off)
        self._most, self._by = most, by

    @property
    def unrecorded(self) -> str:
        """Why a bag is not enough: it records only the times of receipt and the stamps."""
        return (
            "it needs the time at which messages were sent, which a bag does not contain" if self._by == SOURCE else ""
        )

    def evaluate(self, content: Content, failed: bool) -> Finding:
        """Evaluate the message by its stamp, or by the time at which it was sent."""
        age = content.under_way() if self._by == SOURCE else content.age()
        if age is None:
            lacks = "the middleware did not report when it was sent" if self._by == SOURCE else "it has no stamp"
            return Finding(False, f"the age of a message of {self.topic} cannot be determined: {lacks}")
        if age <= self._most:
            return Finding(True, "")
        found = f"{rounded(age)} after it was sent" if self._by == SOURCE else f"with an age of {rounded(age)}"
        return Finding(False, f"a message of {self.topic} arrived {found}")

    def condition(self) -> str:
        """Return the condition in words."""
        since = " since it was sent" if self._by == SOURCE else ""
        return f"an age of at most {duration(self._most)} of {self.topic}{since}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"at most {duration(self._most)} is required"


def rounded(seconds: float) -> str:
    """Format an age, such as ``412 ms`` or ``3.21 s``."""
    return f"{seconds * 1000:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s" if seconds < 1e6 else "over 11 days"


def _check(values: LeafValues) -> None:
    type_, by = values["type"], values["by"]
    known = values.fields(type_) if type_ and values.fields is not None else None
    if by == STAMP and known is not None and next(iter(known.values()), None) != HEADER:
        values.problem(
            "type",
            f"found {type_}, which does not begin with a header; an age needs one with a stamp, or give by: source",
        )


def _plan(values: LeafValues) -> LeafPlan:
    topic, hold_off, most, by = values["topic"], values.hold_off, values["most"], values["by"]
    return LeafPlan(
        f"{topic.lstrip('/')}.age",
        WatchedTopic(topic, values["type"], 0.0, None, contents=1, prompt=fails_on_arrival(hold_off)),
        lambda place: AgeLeaf(place, topic, hold_off, most, by),
    )


AGE = LeafKind(
    "age",
    "while messages are not too old when they arrive",
    (
        topic_key("/scan"),
        TYPE,
        time_key(
            "most",
            "the greatest age of a message when it arrives, such as 300ms",
            missing="give how old a message may be when it arrives, such as 300ms",
        ),
        time_key("for", "how long messages may be older before that is a failure, such as 1s"),
        word_key(
            "by",
            "the time that an age is counted from: the header's stamp, or source, when it was sent",
            "age_by",
            CLOCKS,
            default=STAMP,
        ),
    ),
    "{topic: /scan, type: sensor_msgs/msg/LaserScan, most: 300ms}",
    _plan,
    _check,
)
