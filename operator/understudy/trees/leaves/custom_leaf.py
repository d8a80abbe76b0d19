"""Custom leaves: classes of other packages that judge the messages of a topic (docs/how-to/writing-a-leaf.md).

Such a class receives messages and says what is wrong with them. Everything else that a leaf needs (its topic, how long
the condition must not hold, the judged instance) is here. An error in such a class disables only its leaf, and never
the robot's protection.
"""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from functools import partial
from typing import Any, Protocol

from understudy.trees.core.evidence import Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.leaves.leaf_plan import (
    TYPE,
    Key,
    LeafKind,
    LeafPlan,
    LeafValues,
    fails_on_arrival,
    time_key,
    topic_key,
)
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.value_reader import duration_of, found_text, number_of

_logger = logging.getLogger(__name__)

_SHARED = (
    topic_key("/scan"),
    TYPE,
    time_key("for", "how long it may be false before that is a failure, such as 500ms"),
)

KEYS = tuple(key.name for key in _SHARED)
"""The keys of every custom leaf."""

_UNITS: Mapping[str, str] = {**dict.fromkeys(("gap", "window", "settle"), "time"), "count": "int"}
"""The types of keys that mean the same in all leaves. In OpenSCENARIO 2, all others are texts."""

LONGEST = 200
"""Most characters of a reason."""


class Judge(Protocol):
    """Judges the messages of one instance; each instance gets a new one."""

    def judge(self, message: Any) -> str | None:
        """Return in plain words what is wrong with the message; None if it is good."""
        ...


class CustomLeaf(ContentLeaf):
    """Holds while its judge accepts the newest message, and also if the judge itself fails."""

    def __init__(self, place: LeafPlace, topic: str, hold_off: float, kind: str, make: Callable[[], Judge]) -> None:
        """Make a leaf over a topic; ``hold_off`` in seconds."""
        super().__init__(place, topic, hold_off)
        self.kind = kind
        self._make = make
        self._judge: Judge | None = None

    def forget(self) -> None:
        """Judge another instance, about which nothing is known yet."""
        self._judge = None

    def evaluate(self, content: Content, failed: bool) -> Finding:
        """Return the judge's result for the message."""
        try:
            message = content.message()
        except Unreadable as error:
            return Finding(False, f"{self.topic} cannot be judged: {error}")
        try:
            if self._judge is None:
                self._judge = self._make()
            why = self._judge.judge(message)
            if why is not None and not isinstance(why, str):
                raise TypeError(f"judge() returned {found_text(why)}, which is neither a text nor None")
        except Exception as error:  # a class of another package may raise anything
            self._note(f"{self.kind} cannot judge {self.topic}, {_error_text(error)}")
            return Finding(True, "")  # being unable to judge is not a failure
        self.blind = ""
        return Finding(False, f"{self.topic}: {why[:LONGEST]}") if why else Finding(True, "")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"{self.kind} of {self.topic}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"{self.kind} must accept the message"

    def _note(self, blind: str) -> None:
        if blind != self.blind:
            _logger.error("%s", blind, exc_info=True)
        self.blind = blind


def kind_of(name: str, judge: object) -> LeafKind:
    """Return the kind of leaf for a class, whose keys are the parameters of its constructor. Raises ValueError."""
    if not isinstance(judge, type) or not callable(getattr(judge, "judge", None)):
        raise ValueError("it must be a class with a method judge(self, message)")
    own = _settings(name, judge)
    example = "".join(f", {key.name}: ..." for key in own if key.missing)
    summary = f"while {judge.__name__} accepts the newest message"
    return LeafKind(name, summary, (*_SHARED, *own), f"{{topic: /scan{example}}}", partial(_plan, name, judge, own))


def _settings(name: str, judge: type) -> list[Key]:
    """Return the keys with which a judge is made."""
    try:
        parameters = inspect.signature(judge, eval_str=True).parameters.values()
    except Exception as error:  # annotations are evaluated, which may raise anything
        raise ValueError(f"the parameters of {judge.__name__}() cannot be determined, {_error_text(error)}") from error
    found = []
    for one in parameters:
        if one.kind not in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY):
            raise ValueError(f"its parameter {one.name} cannot be given by name")
        if one.name in (*KEYS, "name"):
            raise ValueError(
                f"its parameter {one.name} has the name of a key that every leaf has; give it another name"
            )
        read = next((read for type_, read in _READS.items() if one.annotation is type_), None)
        if read is None:
            known = ", ".join(type_.__name__ for type_ in _READS)
            raise ValueError(f"its parameter {one.name} must have one of these as its type: {known}")
        missing = f"{name} needs it" if one.default is one.empty else ""
        about, type_ = f"{one.name} of {judge.__name__}", _UNITS.get(one.name, "string")
        found.append(Key(one.name, about, type_, read=read, missing=missing))
    return found


def _plan(name: str, judge: Callable[..., Judge], settings: Sequence[Key], values: LeafValues) -> LeafPlan:
    topic, hold_off = values["topic"], values.hold_off
    make = partial(judge, **{key.name: values[key.name] for key in settings if key.name in values})
    try:
        make()
    except ValueError:  # the class refuses a value
        raise
    except Exception as error:  # a mistake in the class itself
        raise ValueError(f"{name} cannot be made, {_error_text(error)}") from error
    return LeafPlan(
        f"{topic.lstrip('/')}.{name}",
        WatchedTopic(topic, values["type"], 0.0, None, contents=1, whole=True, prompt=fails_on_arrival(hold_off)),
        lambda place: CustomLeaf(place, topic, hold_off, name, make),
    )


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {error!s:.{LONGEST}}"


# -- values of settings: in XML and OpenSCENARIO 2 all of them are texts -----------------------------------------------


def _text(found: object) -> str:
    if not isinstance(found, str):
        raise ValueError(f"found {found_text(found)}; give a text, in quotes if it looks like a number")
    return found


def _number(found: object) -> float:
    number = number_of(found)
    if not math.isfinite(number):
        raise ValueError(f"found {found_text(found)}; give a number")
    return number


def _whole(found: object) -> int:
    number = _number(found)
    if not number.is_integer():
        raise ValueError(f"found {found_text(found)}; give a whole number")
    return int(number)


def _truth(found: object) -> bool:
    if found not in (True, False, "true", "false"):
        raise ValueError(f"found {found_text(found)}; give true or false")
    return found in (True, "true")


def _length(found: object) -> timedelta:
    return timedelta(seconds=duration_of(found))


_READS: Mapping[type, Callable[[object], Any]] = {
    str: _text,
    int: _whole,
    float: _number,
    bool: _truth,
    timedelta: _length,
}
