"""Problems with a tree: the place, what was found, and what would be right."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

MOST_LISTED = 10
"""Maximum number of a tree's problems that are listed if there is no room for all of them."""

_LONGEST_SHOWN = 1000
_LONGEST_WORD = 64
_MOST_WORDS = 50
# The time to compare words grows with the square of their length, and the tree's author chooses many of them.


@dataclass(frozen=True)
class Problem:
    """One mistake in a tree."""

    path: str
    """Its place, such as ``spec.monitoring.yaml.parallel[1].topic.gap``."""
    message: str
    """What was found and what would be right."""

    def __str__(self) -> str:
        return f"{self.path}: {self.message}"


class TreeError(ValueError):
    """A tree cannot be loaded. It has all problems of the tree."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(str(problem) for problem in problems))

    def in_short(self) -> str:
        """Return the first problems, short enough for a condition that may contain other texts."""
        messages = [f"{problem!s:.{_LONGEST_SHOWN}}" for problem in self.problems]
        more = f"; and {len(messages) - MOST_LISTED} more" if len(messages) > MOST_LISTED else ""
        return "; ".join(messages[:MOST_LISTED]) + more


def did_you_mean(found: str, known: Iterable[str]) -> str:
    """Return ``, did you mean X?`` if a known word is similar, else the list of known words."""
    known = _words(known)
    if (close := closest(found, known)) is not None:
        return f", did you mean {close!r}?"
    return f"; known are {', '.join(known)}"


def closest(found: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most similar to a word, if one is similar enough to be meant."""
    close = difflib.get_close_matches(found, _words(known), n=1, cutoff=0.6) if len(found) <= _LONGEST_WORD else []
    return close[0] if close else None


def _words(known: Iterable[str]) -> list[str]:
    return list(itertools.islice((word for word in known if len(word) <= _LONGEST_WORD), _MOST_WORDS))
