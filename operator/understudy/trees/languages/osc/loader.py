"""Loads a health tree from OpenSCENARIO 2 (docs/trees-osc.md), and reports all problems at once."""

from __future__ import annotations

from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.osc.dialects import HEALTH, Dialect
from understudy.trees.languages.osc.document import Document
from understudy.trees.languages.osc.grammar import parse
from understudy.trees.languages.osc.nodes import Nodes
from understudy.trees.languages.text.loader import Read, load_language
from understudy.trees.languages.text.source_map import LocatedProblem, ParsedNode
from understudy.trees.source.expressions import Fields
from understudy.trees.source.positions import WHOLE_FILE, TextOffset

CALLED = "an OpenSCENARIO 2 file"
"""What messages call such a text."""


def load_osc(
    text: object,
    *,
    path: str = "spec.monitoring.osc",
    grace: float = 30.0,
    fields: Fields | None = None,
    begins: TextOffset = WHOLE_FILE,
) -> HealthTree:
    """Load a health tree from a text. It is the tree of the equivalent short form.

    Problems are reported with ``path``; ``grace`` is the number of seconds within which an instance must become healthy
    for the first time. Conditions over messages are checked with the ``fields`` of their types, if these are known.
    Lines and columns are those of the file in which the text ``begins``. Raises TreeError with all problems; of
    problems with the language itself, it has only the first.
    """
    return load_language(text, reader(HEALTH), called=CALLED, path=path, grace=grace, fields=fields, begins=begins)


def reader(dialect: Dialect) -> Read:
    """Return a function that reads trees in a dialect."""

    def read(text: str, path: str, begins: TextOffset) -> tuple[ParsedNode | None, list[LocatedProblem]]:
        document = Document(parse(text, dialect, begins), path, dialect)
        if document.main is None:
            return None, document.problems
        nodes = Nodes(document, path)
        written = nodes.tree(document.main)
        return written, [*document.problems, *nodes.problems]

    return read
