"""Loads procedures and checks: trees that bring one instance to a state, and trees of conditions on it
(docs/procedures.md).

Both are loaded from the short form, regardless of the language in which they were written (procedure_notations.py), and
run inside the instance's pod. Their leaves use the interface :class:`understudy.trees.core.procedure_steps.Actions`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy, Status
from py_trees.composites import Parallel
from py_trees.composites import Sequence as Ordered
from py_trees.decorators import Inverter

from understudy.trees.core.composites import FirstOf
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.procedure_steps import (
    OVERTIME,
    Actions,
    ProcedureFailed,
    ProcedureRun,
    Retry,
    Step,
    TimeLimit,
    Timeout,
    Work,
    reasons,
    unfinished,
)
from understudy.trees.languages.short.step_reader import StepReader
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import LEAVES, REFUSED_PLUGINS
from understudy.trees.source.problems import TreeError, did_you_mean
from understudy.trees.source.value_reader import duration_of, found_text

COMPOSITES = ("sequence", "parallel", "selector")
DECORATORS = ("timeout", "retry", "inverter")
HEALTH = tuple(kind for kind, leaf in LEAVES.items() if not leaf.active_only)
"""Conditions that are leaves of health trees."""

CONDITIONS = ("lifecycle_is", *HEALTH, "node_present", "service_present", "parameter_is")
STEPS = tuple(procedure_leaves.STEPS)
MOST_TRIES = 1000

TICK = 0.05
"""Seconds between two ticks while something depends on time. The end of an action is noticed at once."""

Make = Callable[[ProcedureRun, Sequence[TimeLimit]], Behaviour]
"""Makes a node for one run, with its deadlines."""


class ProcedureTree:
    """A tree that runs once, or repeatedly if it has only conditions."""

    def __init__(self, make: Make, topics: Sequence[WatchedTopic], *, restores_state: bool) -> None:
        self._make = make
        self.topics = list(topics)
        """Topics that its conditions evaluate. They must be watched while it runs."""
        self.restores_state = restores_state
        """Whether a step of the tree restores the kept state."""

    async def run(self, actions: Actions, within: float) -> None:
        """Run it to its end, for at most ``within`` seconds. If this is cancelled, the actions under way are cancelled
        too.

        Raises ProcedureFailed.
        """
        run, limit = ProcedureRun(actions), TimeLimit()
        limit.until = run.clock() + within
        root = self._make(run, [limit])
        try:
            while True:
                run.wake.clear()
                root.tick_once()
                if root.status != Status.RUNNING:
                    break
                if run.clock() >= limit.until + OVERTIME:
                    raise ProcedureFailed(f"not done within {within:g} s: {'; '.join(unfinished(root))}")
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(TICK):
                        await run.wake.wait()
            if root.status == Status.FAILURE:
                raise ProcedureFailed("; ".join(reasons(root)))
        finally:
            if root.status == Status.RUNNING:
                root.stop(Status.INVALID)
            if run.tasks:
                await asyncio.wait(run.tasks)


def load_procedure(tree: object, *, path: str, places: Mapping[str, str] | None = None) -> ProcedureTree:
    """Load the procedure of a node of the short form. Raises TreeError with all its problems.

    If it was written in another language, ``places`` has the positions of its nodes in that text, by their paths in the
    short form. Failures are reported with these positions.
    """
    return _load(_Loader(waits=True, called=_caller(path, places)), tree, path)


def load_check(tree: object, *, path: str, places: Mapping[str, str] | None = None) -> ProcedureTree:
    """Load the check of a node of the short form: a tree of conditions only. Raises TreeError.

    ``places`` as in :func:`load_procedure`.
    """
    return _load(_Loader(waits=False, called=_caller(path, places)), tree, path)


def _caller(path: str, places: Mapping[str, str] | None) -> Callable[[str], str]:
    """Return a function that returns the name of the node at a path for messages."""
    if not places:
        return str
    known = {f"{path}.{inner}": f"{path}, {place}" for inner, place in places.items()}
    return lambda node: known.get(node, node)


def _load(loader: _Loader, tree: object, path: str) -> ProcedureTree:
    make = loader.node(tree, path, 1)
    if loader.problems:
        raise TreeError(loader.problems)
    assert make is not None, "a node without problems can be made"
    return ProcedureTree(make, loader.topics, restores_state="restore_state" in loader.kinds)


class _Loader(StepReader):
    """Converts nodes into makers of their behaviours; a node with a problem becomes None."""

    def __init__(self, *, waits: bool, called: Callable[[str], str]) -> None:
        """``waits`` is True for a procedure, which may act and wait; a check only reads. ``called`` returns the name of
        a node for messages."""
        super().__init__(waits=waits)
        self._called = called
        self.kinds: set[str] = set()
        self._decorators = DECORATORS if waits else ("inverter",)
        self._allowed = (*COMPOSITES, *self._decorators, *(STEPS if waits else ()), *CONDITIONS)

    def node(self, value: object, path: str, depth: int) -> Make | None:
        if not self.is_node(value, path, depth, self._allowed):
            return None
        self._unknown(value, path)
        self.name(value, path)
        kind = self.kind(value, path, self._allowed)
        if kind is None:
            return None
        self.kinds.add(kind)
        place = f"{path}.{kind}"
        if kind in COMPOSITES:
            return self._composite(kind, value[kind], place, depth)
        if kind == "inverter":
            return _around(self.node(value[kind], place, depth + 1), lambda child: Inverter(place, child))
        if kind in self._decorators:
            return self._decorator(kind, value[kind], place, depth)
        before = len(self.problems)
        fields = value[kind]
        if not isinstance(fields, Mapping):
            what = f"such as {LEAVES[kind].example}" if kind in LEAVES else f"of {_FIELDS[kind]}"
            self.problem(place, f"found {found_text(fields)}; {kind!r} must be a mapping {what}")
            return None
        work: Work | None
        work = self.leaf(kind, fields, path) if kind in LEAVES else self.step(kind, fields, place)
        if work is None or len(self.problems) > before:
            return None
        called = self._called(place)
        return lambda run, limits: Step(called, work, run, limits)

    def _unknown(self, value: Mapping[str, Any], path: str) -> None:
        for key in self.unknown(value, (*self._allowed, "name"), path):
            if key in (*STEPS, *DECORATORS):
                self.problem(f"{path}.{key}", f"a check takes no action; {key} belongs in a procedure")
            elif key in REFUSED_PLUGINS:
                self.problem(f"{path}.{key}", REFUSED_PLUGINS[key])
            elif key in ("do", "within", "times", "wait"):
                self.problem(f"{path}.{key}", f"unknown key; {key} belongs inside timeout or retry")
            else:
                self.problem(f"{path}.{key}", f"unknown key {key!r}{did_you_mean(key, (*self._allowed, 'name'))}")

    # -- composites and decorators ----------------------------------------------------------------------------------

    def _composite(self, kind: str, value: object, path: str, depth: int) -> Make | None:
        children = self.children(kind, value, path, lambda child, place: self.node(child, place, depth + 1))
        if children is None:
            return None

        def make(run: ProcedureRun, limits: Sequence[TimeLimit]) -> Behaviour:
            nodes = [child(run, limits) for child in children]
            if kind == "sequence":
                return Ordered(path, memory=True, children=nodes)
            if kind == "selector":
                return FirstOf(path, nodes)
            return Parallel(path, ParallelPolicy.SuccessOnAll(synchronise=True), nodes)

        return make

    def _decorator(self, kind: str, value: object, path: str, depth: int) -> Make | None:
        if not isinstance(value, Mapping):
            self.problem(path, f"found {found_text(value)}; {kind!r} must be a mapping of {_FIELDS[kind]}")
            return None
        before = len(self.problems)
        keys = ("within", "do") if kind == "timeout" else ("times", "wait", "do")
        self.known(value, keys, path)
        for key in keys:
            if key not in value and key != "wait":
                self.problem(f"{path}.{key}", f"missing; {kind} has {_FIELDS[kind]}")
        within = self.optional(value, "within", path, duration_of)
        times = self.optional(value, "times", path, _tries)
        wait = self.optional(value, "wait", path, duration_of) if "wait" in value else 1.0
        child = self.node(value["do"], f"{path}.do", depth + 1) if "do" in value else None
        if child is None or len(self.problems) > before:
            return None
        if kind == "retry":
            return lambda run, limits: Retry(path, child(run, limits), run, times, wait)

        called = self._called(path)

        def make(run: ProcedureRun, limits: Sequence[TimeLimit]) -> Behaviour:
            limit = TimeLimit()
            return Timeout(called, child(run, [*limits, limit]), run, within, limit, limits)

        return make


_FIELDS = {
    "timeout": "within and do",
    "retry": "times, do and optionally wait (1s)",
    "set_lifecycle": "node and state",
    "call_service": "service, type, request, expect and optionally repeat (if it may be called twice)",
    "publish": "topic, type and message",
    "set_parameters": "node and values",
    "wait_for": "topic and type, or service, or node",
    "restore_state": "nothing ({}) or only",
    "resend_goals": "nothing ({})",
    "lifecycle_is": "node and state",
    "node_present": "node",
    "service_present": "service",
    "parameter_is": "node, name and value",
}


def _around(child: Make | None, wrap: Callable[[Behaviour], Behaviour]) -> Make | None:
    if child is None:
        return None
    return lambda run, limits: wrap(child(run, limits))


def _tries(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MOST_TRIES:
        raise ValueError(f"found {found_text(value)}; give the number of attempts, from 1 to {MOST_TRIES}")
    return value
