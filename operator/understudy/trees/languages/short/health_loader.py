"""Loads a health tree from its short YAML form (docs/trees.md), and reports all problems at once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy
from py_trees.composites import Parallel, Sequence
from py_trees.decorators import Inverter

from understudy.trees.core.composites import AnyOf
from understudy.trees.core.health_tree import Build, HealthTree, WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import Evaluation
from understudy.trees.core.task_activity import SETTLE, STATUS_TYPE, TaskActive, While
from understudy.trees.leaves.leaf_plan import LeafPlan
from understudy.trees.leaves.registry import LEAVES, REFUSED_PLUGINS
from understudy.trees.source.expressions import Fields
from understudy.trees.source.problems import Problem, TreeError, did_you_mean
from understudy.trees.source.value_reader import Reader, duration_of, found_text, name_of, type_of

__all__ = ["Problem", "TreeError", "load"]

KINDS = ("parallel", "sequence", "selector", "inverter", "while", *LEAVES)
WHILE_KEYS = ("do", "settle")
TASK_KEYS = ("action", "type")


def load(
    tree: Mapping[str, Any],
    *,
    path: str = "spec.monitoring.yaml",
    grace: float = 30.0,
    fields: Fields | None = None,
    called: Callable[[str], str] = str,
) -> HealthTree:
    """Load the health tree of a node of the short form.

    Problems are reported with ``path``; ``grace`` is the number of seconds within which an instance must become healthy
    for the first time. Conditions over messages are checked with the ``fields`` of their types, if these are known.
    ``called`` returns the name of the node at a path for messages, for trees that were not written in the short form.
    Raises TreeError with all problems.
    """
    loader = _Loader(Evaluation(grace), fields, called)
    build = loader.node(tree, path, [], 1)
    if loader.problems:
        raise TreeError(loader.problems)
    assert build is not None, "a node without problems can be built"
    return HealthTree(build, loader.evaluation, list(loader.topics.values()))


class _Loader(Reader):
    """Converts nodes into builders of their behaviours, and collects problems; a node with a problem becomes None."""

    def __init__(self, evaluation: Evaluation, fields: Fields | None, called: Callable[[str], str]) -> None:
        super().__init__()
        self.evaluation = evaluation
        self._fields = fields
        self._called = called
        self.topics: dict[str, WatchedTopic] = {}
        self._type_paths: dict[str, str] = {}
        self._leaf_paths: dict[str, str] = {}
        self._tasks: list[TaskActive] = []

    def node(self, value: object, path: str, above: list[str], depth: int) -> Build | None:
        """Return the builder of one node; ``above`` are the names of its ancestors."""
        if not self.is_node(value, path, depth, KINDS):
            return None
        known = (*KINDS, "name", *(WHILE_KEYS if "while" in value else ()))
        for key in self.unknown(value, known, path):
            self._unknown_node_key(key, path)
        name = self.name(value, path)
        kind = self.kind(value, path, KINDS)
        if kind is None:
            return None
        below = [*above, name] if name else above
        if kind in LEAVES:
            return self._leaf(kind, value[kind], f"{path}.{kind}", above, name)
        if kind == "while":
            return self._while(value, path, name or kind, below, depth)
        if kind == "inverter":
            child = self.node(value["inverter"], f"{path}.inverter", below, depth + 1)
            return _composite(lambda children: Inverter(name or kind, *children), [child]) if child else None
        return self._composite(kind, value[kind], f"{path}.{kind}", name or kind, below, depth)

    def _while(self, value: Mapping[str, Any], path: str, name: str, below: list[str], depth: int) -> Build | None:
        before = len(self.problems)
        settle = self.optional(value, "settle", path, duration_of) if "settle" in value else SETTLE
        task = self._task(value["while"], f"{path}.while", settle)
        if "do" not in value:
            self.problem(f"{path}.do", "missing; give the node that must hold while the task is active")
            return None
        if task is None:
            self.node(value["do"], f"{path}.do", below, depth + 1)
            return None
        self._tasks.append(task)
        child = self.node(value["do"], f"{path}.do", below, depth + 1)
        self._tasks.pop()
        if child is None or len(self.problems) > before:
            return None

        def build(left_out: Collection[str]) -> Behaviour | None:
            # Without its topic, it is not known whether the task is active: the node is left out then.
            node = child(left_out) if task.topic not in left_out else None
            return While(name, node, task, self.evaluation) if node is not None else None

        return build

    def _task(self, value: object, path: str, settle: float | None) -> TaskActive | None:
        before = len(self.problems)
        if not isinstance(value, Mapping) or "task_active" not in value:
            self.problem(
                path, f"found {found_text(value)}; 'while' must be a mapping with 'task_active', such as {_WHILE}"
            )
            return None
        self.known(value, ("task_active",), path)
        path, fields = f"{path}.task_active", value["task_active"]
        if not isinstance(fields, Mapping):
            self.problem(
                path,
                f"found {found_text(fields)}; 'task_active' must be a mapping with the action's name, such as {_WHILE}",
            )
            return None
        self.known(fields, TASK_KEYS, path)
        if "action" not in fields:
            self.problem(f"{path}.action", "missing; give the action's fully qualified name, such as /navigate_to_pose")
        action = self.optional(fields, "action", path, name_of("action", "/navigate_to_pose"))
        self.optional(fields, "type", path, type_of("action"))
        if action is None or settle is None or len(self.problems) > before:
            return None
        task = TaskActive(action, settle)
        self._watch_task(task)
        return task

    def _watch_task(self, task: TaskActive) -> None:
        known, wanted = self.topics.get(task.topic), WatchedTopic(task.topic, STATUS_TYPE, 0.0, None, task=True)
        stream = replace(wanted, publishers=known.publishers, node=known.node) if known is not None else wanted
        self.topics[task.topic] = stream

    def _unknown_node_key(self, key: str, path: str) -> None:
        if key in WHILE_KEYS:
            self.problem(f"{path}.{key}", f"unknown key; {key} belongs beside while")
            return
        if key in REFUSED_PLUGINS:
            self.problem(f"{path}.{key}", REFUSED_PLUGINS[key])
            return
        if inside := [kind for kind, keys in _LEAF_KEYS.items() if key in keys]:
            kinds = " or ".join(filter(None, (", ".join(inside[:-1]), inside[-1])))
            self.problem(f"{path}.{key}", f"unknown key; {key} belongs inside {kinds}")
        else:
            self.problem(f"{path}.{key}", f"unknown key {key!r}{did_you_mean(key, (*KINDS, 'name'))}")

    def _composite(self, kind: str, value: object, path: str, name: str, below: list[str], depth: int) -> Build | None:
        children = self.children(kind, value, path, lambda child, place: self.node(child, place, below, depth + 1))
        return _composite(lambda nodes: _COMPOSITES[kind](name, nodes), children) if children is not None else None

    def _leaf(self, kind: str, value: object, path: str, above: list[str], name: str | None) -> Build | None:
        """Return the builder of a leaf that evaluates messages."""
        known = LEAVES[kind]
        if not isinstance(value, Mapping):
            self.problem(path, f"found {found_text(value)}; {kind!r} must be a mapping such as {known.example}")
            return None
        plan = known.read(self, value, path, self._fields)
        return self._placed(kind, plan, path, above, name) if plan is not None else None

    def _placed(self, kind: str, plan: LeafPlan, path: str, above: list[str], name: str | None) -> Build | None:
        """Return the builder of a leaf at its place: below the nodes ``above``, and with its given name, if any."""
        leaf_path = "/".join([*above, name or plan.name])
        if leaf_path in self._leaf_paths:
            where = self._called(self._leaf_paths[leaf_path])
            self.problem(path, f"{leaf_path!r} is already the name of {where}; give one of them another name")
            return None
        self._leaf_paths[leaf_path] = path
        if not all(self._watch(topic, path) for topic in (plan.watched, *plan.also)):
            return None

        tasks = tuple(self._tasks)
        needed = {topic.name for topic in (plan.watched, *plan.also) if topic.subscribed}
        if plan.task is not None:
            self._watch_task(plan.task)
            tasks, needed = (*tasks, plan.task), {*needed, plan.task.topic}

        def build(left_out: Collection[str]) -> Behaviour | None:
            if not needed.isdisjoint(left_out):
                return None
            leaf = plan.make(LeafPlace(leaf_path, self.evaluation, tasks))
            leaf.kind = kind
            return leaf

        return _unless(leaf_path, build)

    def _watch(self, wanted: WatchedTopic, path: str) -> bool:
        """Note that a topic is needed; return False, with a problem, if two leaves disagree about its type."""
        topic, known = wanted.name, self.topics.get(wanted.name, wanted)
        if known.task and wanted.subscribed:
            self.problem(
                path,
                f"{topic} is the status of a task's action, which is watched already; it cannot have a rate or gap",
            )
            return False
        if wanted.type and known.type and wanted.type != known.type:
            where = self._called(self._type_paths[topic])
            self.problem(
                f"{path}.type", f"found {wanted.type}, but {where} says {known.type} of the same topic {topic}"
            )
            return False
        if wanted.type:
            self._type_paths.setdefault(topic, f"{path}.type")
        self.topics[topic] = known.joined(wanted)
        return True


_LEAF_KEYS = {kind: leaf.keys for kind, leaf in LEAVES.items()}

_WHILE = "{task_active: {action: /navigate_to_pose}}"

_COMPOSITES: dict[str, Callable[[str, list[Behaviour]], Behaviour]] = {
    "parallel": lambda name, nodes: Parallel(name, ParallelPolicy.SuccessOnAll(synchronise=False), nodes),
    "sequence": lambda name, nodes: Sequence(name, memory=False, children=nodes),
    "selector": AnyOf,
}


def _composite(make: Callable[[list[Behaviour]], Behaviour], children: list[Build]) -> Build:
    """Return a builder of a composite over the children that are not left out; it returns None if all are."""

    def build(left_out: Collection[str]) -> Behaviour | None:
        built = [node for child in children if (node := child(left_out)) is not None]
        return make(built) if built else None

    return build


def _unless(path: str, build: Build) -> Build:
    """Return a builder of the leaf at a path; it returns None if that leaf is left out."""
    return lambda left_out: build(left_out) if path not in left_out else None
