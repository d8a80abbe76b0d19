"""Trees in BehaviorTree.CPP that are replayed, for tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import strategies as st

from understudy.trees.core.health_tree import HealthTree
from understudy.trees.core.observations import RecordedObservations, TopicRecord

START = 1.7e9


def file(*lines: str, name: str = "Main") -> str:
    """A file of one tree, which begins in line 3."""
    inside = "\n".join(lines)
    return f'<root BTCPP_format="4">\n<BehaviorTree ID="{name}">\n{inside}\n</BehaviorTree>\n</root>'


def shape(tree: HealthTree) -> list[tuple[str, str]]:
    """All behaviours, with their kinds."""
    assert tree.root is not None
    return [(type(node).__name__, node.name) for node in tree.root.iterate()]


TOPICS = ("/a", "/b", "/c")


ACTIONS = ("/go", "/grip")


def leaves() -> st.SearchStrategy[dict[str, Any]]:
    topics = st.sampled_from(TOPICS)
    gaps = st.fixed_dictionaries({"name": topics, "gap": st.sampled_from(["100ms", "250ms", "1s", "3s"])})
    rates = st.fixed_dictionaries(
        {"name": topics, "rate": st.sampled_from(["> 4 Hz", ">= 2 Hz", "< 9 Hz", "2 to 8 Hz"]), "window": st.just("1s")}
    )
    return st.builds(lambda topic: {"topic": topic}, gaps | rates | st.builds(lambda a, b: a | b, gaps, rates))


def above(nodes: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    several = st.lists(nodes, min_size=1, max_size=3)
    composites = st.builds(
        lambda key, inside: {key: inside}, st.sampled_from(["parallel", "sequence", "selector"]), several
    )
    tasks = st.builds(
        lambda action, settle, inside: {"while": {"task_active": {"action": action}}, **settle, "do": inside},
        st.sampled_from(ACTIONS),
        st.sampled_from([{}, {"settle": "100ms"}, {"settle": "1s"}]),
        nodes,
    )
    return composites | tasks | st.builds(lambda inside: {"inverter": inside}, nodes)


TREES = st.recursive(leaves(), above, max_leaves=6)


def named(tree: dict[str, Any], number: Callable[[], int]) -> dict[str, Any]:
    """The tree with a name of its own for each leaf, and for some other nodes."""
    if "topic" in tree:
        return {**tree, "name": f"leaf{number()}"}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, list):
            found[key] = [named(child, number) for child in value]
        else:
            found[key] = named(value, number) if key in ("do", "inverter") else value
    place = number()
    return found | ({"name": f"node{place}"} if place % 3 == 0 else {})


def numbers() -> Callable[[], int]:
    count = iter(range(10_000))
    return lambda: next(count)


class Replay:
    """A tree on a script of what arrives and which tasks become active; times are seconds since START."""

    def __init__(self, tree: HealthTree, grace: float) -> None:
        self._tree, self._grace = tree, grace
        self._records = {topic.name: TopicRecord(topic.window) for topic in tree.topics if not topic.task}
        self._tasks: dict[str, float] = {}

    def trace(self, script: list[tuple[float, str]]) -> list[Any]:
        """Verdict, deadline and what counts after each event, and the verdict at each deadline that comes before the next."""
        events: list[Any] = []
        for index, (time, what) in enumerate(script):
            now = START + time
            status = f"{what}/_action/status"
            if what in self._records:
                self._records[what].add(now)
            elif what in ACTIONS and self._tasks.pop(status, None) is None:
                self._tasks[status] = now
            following = script[index + 1][0] if index + 1 < len(script) else time + 10
            events += [(time, what), *self._look(now)]
            deadline = events[-1]
            if deadline is not None and deadline < START + following:
                events += self._look(deadline)
        return events

    def _look(self, now: float) -> list[Any]:
        observations = RecordedObservations(self._records, self._tasks)
        verdict = self._tree.evaluate(observations, now=now, since=START)
        counting = self._tree.counting(observations, now=now, since=START)
        return [verdict, counting, self._tree.deadline(observations, now=now, since=START)]


SCRIPTS = st.lists(
    st.tuples(st.floats(0, 8, allow_nan=False), st.sampled_from([*TOPICS, *TOPICS, *TOPICS, *ACTIONS, "a look"])),
    min_size=5,
    max_size=60,
).map(sorted)


EXAMPLES = Path(__file__).parents[3] / "examples"


POLICIES = [
    pytest.param(item, id=item["metadata"]["name"])
    for file in sorted(EXAMPLES.rglob("*.yaml"))
    for item in yaml.safe_load_all(file.read_text())
    if item and item.get("kind") == "FailurePolicy" and "yaml" in item["spec"]["monitoring"]
]
