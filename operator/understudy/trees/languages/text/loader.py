"""Loads a tree from a text in another language: parses it, then loads it as the short form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from understudy.trees.languages.text.source_map import LocatedProblem, ParsedNode, SourceMap, refusal
from understudy.trees.source.positions import Malformed, TextOffset
from understudy.trees.source.problems import Problem, TreeError
from understudy.trees.source.value_reader import found_text

Read = Callable[[str, str, TextOffset], tuple[ParsedNode | None, list[LocatedProblem]]]
"""Parses a text, given its path and where it begins. Returns the tree (None if it cannot be determined) and the
problems. Raises Malformed."""

Loaded = TypeVar("Loaded")


def load_translated(
    text: object,
    read: Read,
    loaded: Callable[[dict[str, Any], SourceMap], Loaded],
    *,
    called: str,
    path: str,
    begins: TextOffset,
) -> Loaded:
    """Convert a text into the short form and load that with ``loaded``; all problems get their positions in the text.

    ``called`` is what messages call such a text. Raises TreeError.
    """
    if not isinstance(text, str):
        raise TreeError([Problem(path, f"found {found_text(text)}; give the text of {called}")])
    try:
        written, found = read(text, path, begins)
    except Malformed as error:
        raise TreeError([Problem(f"{path}, line {error.line}, column {error.column}", error.message)]) from error
    if written is not None:
        source = SourceMap(path)
        node = source.short_form(written)
        found += source.problems
        try:
            tree = loaded(node, source)
        except TreeError as error:
            found += [source.problem(problem) for problem in error.problems if not source.is_reported(problem)]
        else:
            if not found:
                return tree
    raise refusal(found, path)
