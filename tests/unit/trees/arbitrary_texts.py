"""Texts with anything in them: a loader takes them or refuses them, and does nothing else."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import TypeVar

from tests.unit.trees.world import START
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.core.observations import RecordedObservations
from understudy.trees.source.problems import TreeError

Tree = TypeVar("Tree")


def garbled(text: str, pieces: Sequence[str], *, seed: int, changes: int) -> str:
    """The text with so many parts of it replaced, doubled or left out."""
    chosen = random.Random(seed)
    for _ in range(changes):
        start = chosen.randrange(len(text) + 1)
        end = min(len(text), start + chosen.choice([0, 0, 1, 5, 40, 400]))
        piece = chosen.choice([*pieces, "", text[start:end] * 2, chr(chosen.randrange(0x110000))])
        text = text[:start] + piece + text[end:]
    return text


def loads_or_is_refused(load: Callable[[str], HealthTree], text: str, path: str) -> None:
    """Anything but a TreeError with problems at ``path`` fails the test."""
    tree = loaded_or_refused(load, text, path)
    if tree is not None:
        assert tree.evaluate(RecordedObservations({}), now=START, since=START).state in (
            "Starting",
            "Healthy",
            "Failed",
        )


def loaded_or_refused(load: Callable[[str], Tree], text: str, path: str) -> Tree | None:
    """What was loaded; None where it was refused by a TreeError with problems at ``path``."""
    try:
        return load(text)
    except TreeError as error:
        refused = error.problems
    assert refused
    assert all(problem.path.startswith(path) and problem.message for problem in refused)
    return None
