"""The leaf ``parameter``: the value of a node's parameter (rcl_interfaces/msg/ParameterValue)."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass

from understudy.trees.core.evidence import AnswerLeaf
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import ParameterState, ParameterValue
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, node_key, time_key
from understudy.trees.source.value_reader import found_text

TYPE = "rcl_interfaces/msg/ParameterEvent"

EVENTS = "/parameter_events"
"""The topic on which every node reports changes of its parameters."""

BURST = 4000.0
"""Expected messages per second: a starting stack reports each of its parameters."""

KEPT = 256
"""Greatest number of messages between two evaluations. Values of lost messages are requested."""

LONGEST = 256
"""Most characters of a name or a value."""

MOST_VALUES = 32

SEPARATOR = ";"
"""Separates values that are written as one text, as in BehaviorTree.CPP."""

_WHOLE = re.compile(r"[-+]?[0-9]{1,20}")
_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?"
_BETWEEN = re.compile(rf"({_NUMBER}) to ({_NUMBER})")


class Expected(ABC):
    """A condition on the value of a parameter."""

    @abstractmethod
    def holds(self, value: ParameterValue) -> bool:
        """Return whether a value is as expected."""

    @abstractmethod
    def __str__(self) -> str:
        """Return the condition in words, to follow the parameter's name."""


@dataclass(frozen=True)
class OneOf(Expected):
    """One of several values, each as it is written. They are compared as the parameter's own type: number, string or
    boolean."""

    texts: tuple[str, ...]

    def holds(self, value: ParameterValue) -> bool:
        """Return whether a value is one of them."""
        return any(_equal(value, text) for text in self.texts)

    def __str__(self) -> str:
        if len(self.texts) == 1:
            return f"equal to {self.texts[0]}"
        return f"equal to one of {', '.join(self.texts)}"


@dataclass(frozen=True)
class Between(Expected):
    """A number in a closed interval."""

    least: float
    most: float

    def holds(self, value: ParameterValue) -> bool:
        """Return whether a value is a number in the interval."""
        return isinstance(value, int | float) and not isinstance(value, bool) and self.least <= value <= self.most

    def __str__(self) -> str:
        return f"between {self.least:g} and {self.most:g}"


def _equal(value: ParameterValue, text: str) -> bool:
    if isinstance(value, bool):
        return text.lower() == str(value).lower()
    if isinstance(value, str):
        return text == value
    if _WHOLE.fullmatch(text):
        return int(text) == value
    return re.fullmatch(_NUMBER, text) is not None and float(text) == value


class ParameterLeaf(AnswerLeaf[ParameterState]):
    """Holds while a parameter of a node has an expected value, or while its value cannot be determined."""

    def __init__(self, place: LeafPlace, node: str, hold_off: float, name: str, expected: Expected) -> None:
        """Make a leaf over a parameter of a node, fully qualified; ``hold_off`` in seconds."""
        super().__init__(place, EVENTS, hold_off)
        self._node, self._name, self._expected = node, name, expected

    def newest(self) -> ParameterState | None:
        """Return the known value of the parameter."""
        return self._evaluation.observations.parameter(self._node, self._name)

    def wrong(self, content: ParameterState) -> str:
        """Return which other value it has."""
        subject = f"parameter {self._name} of node {self._node}"
        if content.value is None:
            return f"{subject} {content.lacks.removeprefix('it ')}"
        return "" if self._expected.holds(content.value) else f"{subject} is {found_text(content.value)}"

    def condition(self) -> str:
        """Return the condition in words."""
        return f"parameter {self._name} of node {self._node} {self._expected}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"a value {self._expected} is required"

    def awaited(self) -> str:
        """Return what must arrive first."""
        return f"answer of node {self._node} about its parameter {self._name}"


_WAYS = ("equals", "one_of", "between")


def _check(values: LeafValues) -> None:
    ways = [way for way in _WAYS if way in values]
    if len(ways) != 1:
        found = " and ".join(ways) if ways else "none of equals, one_of and between"
        values.problem("", f"found {found}; give one of them, such as equals: 0.26")


def _plan(values: LeafValues) -> LeafPlan:
    node, hold_off, name = values["node"], values.hold_off, values["name"]
    (expected,) = (values[way] for way in _WAYS if way in values)
    return LeafPlan(
        f"{node.lstrip('/')}.{name}.parameter",
        WatchedTopic(EVENTS, TYPE, 0.0, BURST, contents=KEPT, whole=True, parameters=frozenset({(node, name)})),
        lambda place: ParameterLeaf(place, node, hold_off, name, expected),
    )


def _name(found: object) -> str:
    if not isinstance(found, str) or not re.fullmatch(rf"\S{{1,{LONGEST}}}", found):
        raise ValueError(
            f"found {found_text(found)}; give a parameter's name such as max_vel_x or FollowPath.max_vel_x"
        )
    return found


def _equals(found: object) -> Expected:
    return OneOf((_text(found),))


def _one_of(found: object) -> Expected:
    values = found.split(SEPARATOR) if isinstance(found, str) else found
    if not isinstance(values, list) or not 1 <= len(values) <= MOST_VALUES:
        raise ValueError(
            f"found {found_text(found)}; give a list of 1 to {MOST_VALUES} values, or a text with '{SEPARATOR}' between them"
        )
    return OneOf(tuple(_text(one.strip() if isinstance(one, str) else one) for one in values))


def _between(found: object) -> Expected:
    if isinstance(found, list) and len(found) == 2:
        found = f"{_text(found[0])} to {_text(found[1])}"
    match = _BETWEEN.fullmatch(found) if isinstance(found, str) and len(found) <= 2 * LONGEST else None
    least, most = (float(match[1]), float(match[2])) if match is not None else (1.0, 0.0)
    if not (least <= most and math.isfinite(least) and math.isfinite(most)):
        raise ValueError(f"found {found_text(found)}; give the least and the greatest number, such as 0.2 to 0.3")
    return Between(least, most)


def _text(found: object) -> str:
    """Return a value as it is written. A value in YAML may be a number or a boolean."""
    if isinstance(found, bool):
        return str(found).lower()
    if isinstance(found, float) and not math.isfinite(found):
        raise ValueError(f"found {found}, which no parameter can be compared with; give a number")
    if not isinstance(found, str | int | float) or len(str(found)) > LONGEST:
        raise ValueError(
            f"found {found_text(found)}; give a number, a text of up to {LONGEST} characters, true or false"
        )
    return str(found)


PARAMETER = LeafKind(
    "parameter",
    "while a parameter of a node has the right value",
    (
        node_key("the node, fully qualified, such as /controller_server"),
        Key(
            "name",
            "the parameter, such as max_vel_x",
            xml="parameter",
            read=_name,
            missing="give the parameter's name, such as max_vel_x",
        ),
        Key("equals", "the value that it must have, such as 0.26", read=_equals),
        Key("one_of", "the values of which it must have one, separated by ;", read=_one_of),
        Key("between", "the least and the greatest allowed number, such as 0.2 to 0.3", read=_between),
        time_key("for", "how long it may differ before that is a failure, such as 1s"),
    ),
    "{node: /controller_server, name: max_vel_x, equals: 0.26}",
    _plan,
    _check,
)
