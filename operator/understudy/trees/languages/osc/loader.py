"""Reads trees in OpenSCENARIO 2 (docs/trees-osc.md). Reports all problems at once, but only the first one with the language itself."""

from __future__ import annotations

from understudy.trees.languages.osc.dialects import Dialect
from understudy.trees.languages.osc.document import Document
from understudy.trees.languages.osc.grammar import parse
from understudy.trees.languages.osc.nodes import Nodes
from understudy.trees.languages.text.loader import Read
from understudy.trees.languages.text.source_map import LocatedProblem, ParsedNode
from understudy.trees.source.positions import TextOffset

CALLED = "an OpenSCENARIO 2 file"
"""What messages call such a text."""


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
