"""Loads a tree from a text in another language: parsed first, then loaded as the short form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.short.health_loader import load
from understudy.trees.languages.text.source_map import LocatedProblem, ParsedNode, SourceMap, refusal
from understudy.trees.source.expressions import Fields
from understudy.trees.source.positions import Malformed, TextOffset
from understudy.trees.source.problems import Problem, TreeError
from understudy.trees.source.value_reader import found_text

Read = Callable[[str, str, TextOffset], tuple[ParsedNode | None, list[LocatedProblem]]]
"""What was written in a text (None if that cannot be determined) and what is wrong with it; given its path and where it begins.
Raises Malformed."""

Loaded = TypeVar("Loaded")


def load_language(
    text: object, read: Read, *, called: str, path: str, grace: float, fields: Fields | None, begins: TextOffset
) -> HealthTree:
    """The health tree that a text stands for: that of the short form which says the same.

    ``called`` is what such a text is; the others are as of the loaders of the languages. Raises TreeError with all problems.
    """

    def loaded(node: dict[str, Any], source: SourceMap) -> HealthTree:
        return load(node, path=path, grace=grace, fields=fields, called=source.called)

    return load_translated(text, read, loaded, called=called, path=path, begins=begins)


def load_translated(
    text: object,
    read: Read,
    loaded: Callable[[dict[str, Any], SourceMap], Loaded],
    *,
    called: str,
    path: str,
    begins: TextOffset,
) -> Loaded:
    """What is ``loaded`` from the node of the short form that a text stands for, with all problems at their places in it.

    ``called`` is what such a text is. Raises TreeError.
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
            found += [source.problem(problem) for problem in error.problems if not source.told(problem)]
        else:
            if not found:
                return tree
    raise refusal(found, path)
