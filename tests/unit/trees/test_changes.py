"""What a tree foretells of its leaves, what it is judged without, and when its failure counts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.trees.world import START, World
from understudy.trees.core.debounce import Debounce

TREE = {
    "parallel": [
        {"topic": {"name": "/a", "gap": "1s"}},
        {"topic": {"name": "/b", "rate": "<= 4 Hz", "window": "1s"}},
        {"inverter": {"topic": {"name": "/c", "gap": "500ms"}}},
        {"publisher": {"topic": "/a"}},
    ]
}

times = st.lists(st.integers(0, 5000), max_size=12)
"""Milliseconds."""


def states(world: World, now: float) -> list[str]:
    world.at(now)
    return [leaf.status.name for leaf in world.tree.leaves]


@given(a=times, b=times, c=times)
def test_no_leaf_changes_before_the_predicted_moment(a: list[int], b: list[int], c: list[int]) -> None:
    world = World(TREE, grace=2.0)
    for topic, stamps in (("/a", a), ("/b", b), ("/c", c)):
        for at in sorted(stamps):
            world.hear(topic, at / 1000)
    now, looks = 5.0, 0
    while (change := world.tree.next_change(world.observed(), now=START + now, since=START)) is not None:
        before, at = states(world, now), change - START
        assert at > now
        assert states(world, now + (at - now) * 0.999) == before
        now, looks = at, looks + 1
        assert looks < 100, "it comes to an end"
    assert states(world, now + 1e6) == states(world, now)


def test_the_path_of_a_leaf_excludes_only_that_leaf() -> None:
    world = World(TREE)
    assert [leaf.name for leaf in world.tree.leaves] == ["a", "b", "c", "a.publisher"]
    world.tree.leave_out({"a.publisher"})
    assert [leaf.name for leaf in world.tree.leaves] == ["a", "b", "c"]
    world.tree.leave_out({"/a"})
    assert [leaf.name for leaf in world.tree.leaves] == ["b", "c", "a.publisher"]


@pytest.mark.parametrize("length", [0.0, 0.3])
def test_a_failure_counts_after_it_lasted_without_interruption(length: float) -> None:
    debounce = Debounce()
    assert debounce.failed(10.0, length) == 10.0 + length
    assert debounce.failed(10.2, length) == 10.0 + length, "since when is remembered"
    debounce.clear()
    assert debounce.failing_since is None
    assert debounce.failed(11.0, length) == 11.0 + length
