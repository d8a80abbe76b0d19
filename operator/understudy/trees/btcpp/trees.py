"""Loads a health tree from BehaviorTree.CPP 4 XML (docs/trees.md) and says everything that is wrong with it at once."""

from __future__ import annotations

from collections.abc import Iterable

from understudy.trees.btcpp.document import Document
from understudy.trees.btcpp.markup import ALONE, Beginning, Malformed, parse
from understudy.trees.btcpp.nodes import ENOUGH, Nodes
from understudy.trees.btcpp.writing import Found, SourceMap
from understudy.trees.expressions import Fields
from understudy.trees.health import HealthTree
from understudy.trees.loading import load
from understudy.trees.problems import Problem, TreeError
from understudy.trees.reading import found_text


def load_xml(
    text: object,
    *,
    path: str = "spec.monitoring.xml",
    grace: float = 30.0,
    fields: Fields | None = None,
    begins: Beginning = ALONE,
) -> HealthTree:
    """The health tree that a text stands for: that of the short form which says the same.

    ``path`` is what problems are named by, ``grace`` the seconds that an instance has to become healthy for the first
    time. Conditions over messages are checked by their types' ``fields``, where these are known. Lines and
    columns are those of the file in which the text ``begins``. Raises TreeError with all problems.
    """
    if not isinstance(text, str):
        raise TreeError([Problem(path, f"found {found_text(text)}; give the text of a BehaviorTree.CPP 4 file")])
    try:
        root = parse(text, begins)
    except Malformed as error:
        raise TreeError([Problem(f"{path}, line {error.line}, column {error.column}", error.message)]) from error
    document = Document(root, path)
    if document.main is None:
        raise _error(document.problems, path)
    nodes = Nodes(document, path)
    written = nodes.tree(document.main)
    found = [*document.problems, *nodes.problems]
    if written is not None:
        source = SourceMap(path)
        try:
            tree = load(source.short_form(written), path=path, grace=grace, fields=fields, called=source.called)
        except TreeError as error:
            found += [source.problem(problem) for problem in error.problems]
        else:
            if not found:
                return tree
    raise _error(found, path)


def _error(found: Iterable[Found], path: str) -> TreeError:
    # A subtree that is used twice has its mistakes once.
    listed = sorted(dict.fromkeys(found), key=lambda one: (one.line, one.column))
    problems = [one.problem for one in listed[:ENOUGH]]
    if len(listed) > ENOUGH:
        problems.append(Problem(path, f"and {len(listed) - ENOUGH} more"))
    return TreeError(problems)
