"""Loads a health tree from its short YAML form (docs/trees.md) and says everything that is wrong with it at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy
from py_trees.composites import Parallel, Sequence
from py_trees.decorators import Inverter

from understudy.api.base import seconds
from understudy.api.rosnames import ROS_NAME_PATTERN, ROS_TYPE_PATTERN
from understudy.trees.composites import AnyOf
from understudy.trees.health import Build, HealthTree, WatchedTopic
from understudy.trees.leaves import Glance, TopicLeaf, duration
from understudy.trees.problems import Problem, TreeError, did_you_mean
from understudy.trees.rates import Band, Window

__all__ = ["Problem", "TreeError", "load"]

KINDS = ("parallel", "sequence", "selector", "inverter", "topic")
TOPIC_KEYS = ("name", "type", "gap", "rate", "window")
DEEPEST = 32
"""Levels a tree may have; a healthy one has three or four."""
MOST = 512
"""Nodes a tree may have."""
LONGEST = 24 * 3600
"""Seconds that a gap or a window may have."""

_NODE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,63}")


def load(tree: Mapping[str, Any], *, path: str = "spec.monitoring.yaml", grace: float = 30.0) -> HealthTree:
    """The health tree that a node of the short form stands for.

    ``path`` is what problems are named by, ``grace`` the seconds that an instance has to become healthy for the first
    time. Raises TreeError with all problems.
    """
    loader = _Loader(Glance(grace))
    build = loader.node(tree, path, [], 1)
    if loader.problems:
        raise TreeError(loader.problems)
    assert build is not None, "a node without problems can be built"
    return HealthTree(build, loader.glance, list(loader.topics.values()))


class _Loader:
    """Turns nodes into what builds their behaviours, and collects problems; one with a problem in it becomes None."""

    def __init__(self, glance: Glance) -> None:
        self.glance = glance
        self.problems: list[Problem] = []
        self.topics: dict[str, WatchedTopic] = {}
        self._type_paths: dict[str, str] = {}
        self._leaf_paths: dict[str, str] = {}
        self._nodes = 0

    def problem(self, path: str, message: str) -> None:
        self.problems.append(Problem(path, message))

    def node(self, value: object, path: str, above: list[str], depth: int) -> Build | None:
        """What builds one node; ``above`` are the names of the nodes it is in."""
        self._nodes += 1
        if self._nodes > MOST:
            if self._nodes == MOST + 1:
                self.problem(path, f"the tree has more than {MOST} nodes")
            return None
        if depth > DEEPEST:
            self.problem(path, f"the tree is more than {DEEPEST} levels deep")
            return None
        if not isinstance(value, Mapping):
            self.problem(path, f"found {_found(value)}; a node is a mapping with one of {', '.join(KINDS)}")
            return None
        kinds = [kind for kind in KINDS if kind in value]
        for key in value:
            if key not in KINDS and key != "name":
                self._unknown_node_key(str(key), path)
        name = self._name(value, path)
        if len(kinds) > 1:
            self.problem(path, f"found {' and '.join(kinds)} in one node; give each a node of its own")
            return None
        if not kinds:
            if not any(key != "name" for key in value):
                self.problem(path, f"the node says nothing; give one of {', '.join(KINDS)}")
            return None
        kind = kinds[0]
        below = [*above, name] if name else above
        if kind == "topic":
            return self._topic(value["topic"], f"{path}.topic", above, name)
        if kind == "inverter":
            child = self.node(value["inverter"], f"{path}.inverter", below, depth + 1)
            return _composite(lambda children: Inverter(name or kind, *children), [child]) if child else None
        return self._composite(kind, value[kind], f"{path}.{kind}", name or kind, below, depth)

    def _unknown_node_key(self, key: str, path: str) -> None:
        if key in TOPIC_KEYS:
            self.problem(f"{path}.{key}", f"unknown key; {key} belongs inside topic")
        else:
            self.problem(f"{path}.{key}", f"unknown key {key!r}{did_you_mean(key, (*KINDS, 'name'))}")

    def _name(self, value: Mapping[str, Any], path: str) -> str | None:
        if "name" not in value:
            return None
        name = value["name"]
        if not isinstance(name, str) or not _NODE_NAME.fullmatch(name):
            self.problem(
                f"{path}.name", f"found {_found(name)}; a node's name is 1 to 63 letters, digits, '_', '-' and '.'"
            )
            return None
        return name

    def _composite(self, kind: str, value: object, path: str, name: str, below: list[str], depth: int) -> Build | None:
        if not isinstance(value, list):
            self.problem(path, f"found {_found(value)}; {kind} has a list of nodes")
            return None
        if not value:
            self.problem(path, f"the list is empty; {kind} needs at least one node")
            return None
        built = [self.node(child, f"{path}[{i}]", below, depth + 1) for i, child in enumerate(value)]
        children = [child for child in built if child is not None]
        if len(children) < len(built):
            return None
        return _composite(lambda nodes: _COMPOSITES[kind](name, nodes), children)

    def _topic(self, value: object, path: str, above: list[str], name: str | None) -> Build | None:
        before = len(self.problems)
        if not isinstance(value, Mapping):
            self.problem(path, f"found {_found(value)}; topic is a mapping with name and with gap or rate")
            return None
        for key in value:
            if key not in TOPIC_KEYS:
                self.problem(f"{path}.{key}", f"unknown key {str(key)!r}{did_you_mean(str(key), TOPIC_KEYS)}")
        topic = self._matching(value, "name", path, ROS_NAME_PATTERN, "a fully qualified topic name such as /cmd_vel")
        if "name" not in value:
            self.problem(f"{path}.name", "missing; give the topic's fully qualified name, such as /cmd_vel")
        type_ = self._matching(
            value, "type", path, ROS_TYPE_PATTERN.replace("(msg|srv|action)", "msg"), "package/msg/Name"
        )
        gap = self._given(value, "gap", path, _duration)
        band = self._given(value, "rate", path, _band)
        length = self._given(value, "window", path, _duration)
        if "gap" not in value and "rate" not in value:
            self.problem(path, "neither gap nor rate is given; give gap, such as 500ms, or rate, such as '> 8 Hz'")
        if "window" in value and "rate" not in value:
            self.problem(f"{path}.window", "a window is only for a rate; give rate, or leave window out")
        window = self._window(band, length, path) if band is not None else None
        if topic is None or len(self.problems) > before:
            return None
        leaf_path = "/".join([*above, name or topic.lstrip("/")])
        if leaf_path in self._leaf_paths:
            where = self._leaf_paths[leaf_path]
            self.problem(path, f"{leaf_path!r} is already the name of {where}; give one of them another name")
            return None
        self._leaf_paths[leaf_path] = path
        if not self._watch(topic, type_, window, path):
            return None

        def build(left_out: Collection[str]) -> Behaviour | None:
            return None if topic in left_out else TopicLeaf(leaf_path, topic, self.glance, gap=gap, window=window)

        return build

    def _window(self, band: Band, length: float | None, path: str) -> Window | None:
        shortest = band.shortest_window()
        if length is not None and length < shortest:
            self.problem(
                f"{path}.window",
                f"{duration(length)} is too short to tell whether a rate is {band}: a window counts whole messages; "
                f"give at least {duration(shortest)}",
            )
            return None
        return Window(band, length if length is not None else band.default_window())

    def _watch(self, topic: str, type_: str | None, window: Window | None, path: str) -> bool:
        """Note that a topic is needed; False, with a problem, where two leaves differ about its type."""
        known = self.topics.get(topic, WatchedTopic(topic, None, 0.0, None))
        if type_ and known.type and type_ != known.type:
            where = self._type_paths[topic]
            self.problem(f"{path}.type", f"found {type_}, but {where} says {known.type} of the same topic {topic}")
            return False
        if type_:
            self._type_paths.setdefault(topic, f"{path}.type")
        rates = [rate for rate in (known.rate, window.band.expected if window else None) if rate is not None]
        self.topics[topic] = WatchedTopic(
            topic,
            type_ or known.type,
            max(known.window, window.length if window else 0.0),
            max(rates) if rates else None,
        )
        return True

    def _matching(self, value: Mapping[str, Any], key: str, path: str, pattern: str, right: str) -> str | None:
        if key not in value:
            return None
        found = value[key]
        if not isinstance(found, str) or not re.fullmatch(pattern, found):
            message = f"found {_found(found)}; give {right}"
            if isinstance(found, str) and re.fullmatch(pattern, f"/{found}"):
                message = f"found {_found(found)}; did you mean '/{found}'?"
            self.problem(f"{path}.{key}", message)
            return None
        return found

    def _given(self, value: Mapping[str, Any], key: str, path: str, read: Callable[[object], Any]) -> Any:
        if key not in value:
            return None
        try:
            return read(value[key])
        except ValueError as error:
            self.problem(f"{path}.{key}", str(error))
            return None


_COMPOSITES: dict[str, Callable[[str, list[Behaviour]], Behaviour]] = {
    "parallel": lambda name, nodes: Parallel(name, ParallelPolicy.SuccessOnAll(synchronise=False), nodes),
    "sequence": lambda name, nodes: Sequence(name, memory=False, children=nodes),
    "selector": AnyOf,
}


def _composite(make: Callable[[list[Behaviour]], Behaviour], children: list[Build]) -> Build:
    """Builds a node over those of its children that are not left out; none where all are."""

    def build(left_out: Collection[str]) -> Behaviour | None:
        built = [node for child in children if (node := child(left_out)) is not None]
        return make(built) if built else None

    return build


def _duration(value: object) -> float:
    if not isinstance(value, str):
        raise ValueError(f"found {_found(value)}, which has no unit; write it with ms, s, m or h, such as 500ms")
    length = seconds(value)
    if length <= 0:
        raise ValueError(f"found {value!r}; it must be longer than 0")
    if length > LONGEST:
        raise ValueError(f"found {value!r}; it must be at most {LONGEST // 3600}h")
    return length


def _band(value: object) -> Band:
    if not isinstance(value, str):
        raise ValueError(f"found {_found(value)}; write '> 8 Hz', '>= 8 Hz', '< 20 Hz', '<= 20 Hz' or '9 to 11 Hz'")
    return Band.parse(value)


def _found(value: object) -> str:
    """A value in words for a message."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
