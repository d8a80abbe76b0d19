"""The parts of a file: its trees, the main tree, and the models of their ports."""

from __future__ import annotations

from understudy.trees.languages.btcpp import port_models
from understudy.trees.languages.btcpp.library import Library
from understudy.trees.languages.btcpp.origins import origin
from understudy.trees.languages.btcpp.port_models import SubTreeModel
from understudy.trees.languages.btcpp.xml_elements import Element
from understudy.trees.languages.text.source_map import LocatedProblem
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import found_text

FORMAT = "4"
"""The version of BehaviorTree.CPP whose format is read."""


class Document:
    """The parts of a file, and the problems with them."""

    def __init__(self, root: Element, path: str, library: Library) -> None:
        self.problems: list[LocatedProblem] = []
        self.trees: dict[str, Element] = {}
        """By ID."""
        self.models: dict[str, SubTreeModel] = {}
        """Models of subtrees, by ID."""
        self.main: str | None = None
        """The tree to execute; None if it cannot be determined. Trees that it does not use are ignored."""
        self.library = library
        self._path = path
        if root.tag != "root":
            self._note(root, 'the outermost element is <root BTCPP_format="4">')
            return
        version = root.attributes.get("BTCPP_format")
        if version != FORMAT:
            found = "missing" if version is None else f"found {found_text(version)}"
            self._note(
                root, f"{found}; write {FORMAT!r}: in other versions the same nodes mean other things", "BTCPP_format"
            )
            return
        for element in root.children:
            self._part(element)
        self.main = self._main(root)

    def _part(self, element: Element) -> None:
        name = element.attributes.get("ID", "")
        if element.tag == "BehaviorTree":
            if not name:
                self._note(element, "missing; give the tree a name", "ID")
            elif name in self.trees:
                self._note(
                    element, f"there is one in line {self.trees[name].line} already; give each a name of its own"
                )
            else:
                self.trees[name] = element
        elif element.tag == "TreeNodesModel":
            self.models.update(port_models.read(element, self.library.nodes, self._note))
        elif element.tag == "include":
            self._note(element, "no files are read; write the <BehaviorTree> that is in that file here")
        else:
            self._note(element, f"unknown element{did_you_mean(element.tag, ('BehaviorTree', 'TreeNodesModel'))}")

    def _main(self, root: Element) -> str | None:
        main_tree, trees = root.attributes.get("main_tree_to_execute"), list(self.trees)
        if not trees:
            if not self.problems:
                self._note(root, 'has no tree in it; give it one <BehaviorTree ID="...">')
        elif main_tree is None and len(trees) == 1:
            return trees[0]
        elif main_tree is None:
            self._note(root, f"missing; give one of {', '.join(trees):.200}", "main_tree_to_execute")
        elif main_tree not in self.trees:
            self._note(
                root,
                f"there is no tree {found_text(main_tree)}{did_you_mean(main_tree, trees):.200}",
                "main_tree_to_execute",
            )
        else:
            return main_tree
        return None

    def _note(self, element: Element, message: str, attribute: str = "") -> None:
        self.problems.append(origin(element).problem(self._path, message, attribute))
