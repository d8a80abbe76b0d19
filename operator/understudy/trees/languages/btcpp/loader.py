"""Reads trees in BehaviorTree.CPP 4 XML (docs/trees.md). Reports all problems at once."""

from __future__ import annotations

from understudy.trees.languages.btcpp.document import Document
from understudy.trees.languages.btcpp.library import Library
from understudy.trees.languages.btcpp.nodes import Nodes
from understudy.trees.languages.btcpp.xml_elements import parse
from understudy.trees.languages.text.loader import Read
from understudy.trees.languages.text.source_map import LocatedProblem, ParsedNode
from understudy.trees.source.positions import TextOffset

CALLED = "a BehaviorTree.CPP 4 file"
"""What messages call such a text."""


def reader(library: Library) -> Read:
    """Return a function that reads trees with the nodes of a library."""

    def read(text: str, path: str, begins: TextOffset) -> tuple[ParsedNode | None, list[LocatedProblem]]:
        document = Document(parse(text, begins), path, library)
        if document.main is None:
            return None, document.problems
        nodes = Nodes(document, path)
        written = nodes.tree(document.main)
        return written, [*document.problems, *nodes.problems]

    return read
