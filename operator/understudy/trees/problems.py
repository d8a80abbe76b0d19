"""What is wrong with a tree, in words that say where and what would be right."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Problem:
    """One mistake in a tree."""

    path: str
    """Where, such as ``spec.monitoring.yaml.parallel[1].topic.gap``."""
    message: str
    """What was found and what would be right."""

    def __str__(self) -> str:
        return f"{self.path}: {self.message}"


class TreeError(ValueError):
    """A tree that can't be loaded; all its problems at once."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(str(problem) for problem in problems))


def did_you_mean(found: str, known: Iterable[str]) -> str:
    """``, did you mean X?`` where a known word is close, else the list of what is known."""
    known = list(known)
    close = difflib.get_close_matches(found, known, n=1, cutoff=0.6)
    if close:
        return f", did you mean {close[0]!r}?"
    return f"; known are {', '.join(known)}"
