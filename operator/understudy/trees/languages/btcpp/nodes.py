"""Reads the nodes of a tree, and replaces each subtree by its nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from understudy.trees.languages.btcpp import blackboard
from understudy.trees.languages.btcpp.blackboard import Board
from understudy.trees.languages.btcpp.document import Document
from understudy.trees.languages.btcpp.library import EXPLICIT, IGNORED, SCRIPTS
from understudy.trees.languages.btcpp.origins import origin
from understudy.trees.languages.btcpp.xml_elements import Element
from understudy.trees.languages.text.source_map import MOST_PROBLEMS, LocatedProblem, ParsedNode
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import DEEPEST, MOST, found_text

SUBTREE = "SubTree"


@dataclass(frozen=True)
class _Spot:
    """The place of a node in the tree."""

    board: Board
    trees: tuple[str, ...]
    """The trees that contain it, the main tree first."""
    uses: tuple[int, ...]
    """The lines in which all of these trees but the first are used."""
    depth: int

    def below(self) -> _Spot:
        return replace(self, depth=self.depth + 1)


class Nodes:
    """Converts elements to parsed nodes, and collects problems; an element that cannot be read becomes None."""

    def __init__(self, document: Document, path: str) -> None:
        self.problems: list[LocatedProblem] = []
        self._document, self._path = document, path
        self._library = document.library
        self._count = 0
        self._read: dict[str, set[str] | None] = {}

    def tree(self, main: str) -> ParsedNode | None:
        """Read the tree with this name, and all trees that it uses."""
        return self._tree(main, _Spot({}, (main,), (), 1))

    def _tree(self, name: str, spot: _Spot) -> ParsedNode | None:
        element = self._document.trees[name]
        self._no_text(element)
        if len(element.children) != 1:
            self._note(element, f"has {_nodes(element)} in it; {self._one()}")
            return None
        return self._node(element.children[0], spot)

    def _node(self, element: Element, spot: _Spot) -> ParsedNode | None:
        self._count += 1
        if self._count > MOST:
            if self._count == MOST + 1:
                self._note(element, f"the tree has more than {MOST} nodes")
            return None
        if len(self.problems) > MOST_PROBLEMS:
            return None
        if spot.depth > DEEPEST:
            self._note(element, f"the tree is more than {DEEPEST} levels deep")
            return None
        self._no_text(element)
        if element.tag == SUBTREE:
            return self._subtree(element, spot)
        tag = self._tag(element)
        if tag is None:
            return None
        values = self._values(element, tag, spot.board)
        built = [self._node(child, spot.below()) for child in element.children]
        children = [child for child in built if child is not None]
        key = self._key(element, tag, values)
        if values is None or key is None or (element.children and not children):
            return None
        node = self._library.nodes[tag]
        ports = {port: where for port, where in node.ports.items() if where}
        name = _name(element, tag) if self._library.subject.named else None
        return ParsedNode(origin(element, spot.uses), key, name, ports, values, children, reads=node.reads)

    def _tag(self, element: Element) -> str | None:
        """Return which of the known nodes it is, in the compact or the explicit notation."""
        tag = element.tag
        if tag in EXPLICIT:
            if "ID" not in element.attributes:
                self._note(element, "missing; say which node it is", "ID")
                return None
            tag = element.attributes["ID"]
        library = self._library
        if tag in library.nodes:
            node = library.nodes[tag]
            if element.tag in (tag, node.category):
                return tag
            self._note(element, f"{tag} is {node.a}; write <{tag}>")
        elif tag in library.refused:
            self._note(element, f"is not for {library.subject.many}: {library.refused[tag]}")
        elif tag in self._document.trees:
            self._note(element, f'it is a tree; write <SubTree ID="{tag:.60}"/>')
        else:
            self._note(element, f"unknown node{did_you_mean(tag, (*library.nodes, SUBTREE))}")
        return None

    def _values(self, element: Element, tag: str, board: Board) -> dict[str, str] | None:
        """Return the values of its ports; None if one of them cannot be determined."""
        ports, whole = self._library.nodes[tag].ports, True
        values: dict[str, str] = {}
        for attribute, value in element.attributes.items():
            if attribute == "name" or attribute in IGNORED or (attribute == "ID" and element.tag in EXPLICIT):
                continue
            if attribute in SCRIPTS:
                self._note(element, self._library.no_scripts, attribute)
            elif attribute not in ports:
                known = (*ports, "name")
                self._note(element, f"unknown port{did_you_mean(attribute, known)}", attribute)
            elif (found := self._resolved(element, attribute, value, board)) is None:
                whole = False
            elif found.strip():  # an editor writes the ports that were left empty too
                values[attribute] = found
        return values if whole else None

    def _resolved(self, element: Element, port: str, value: str, board: Board) -> str | None:
        try:
            return blackboard.resolve(value, port, board)
        except ValueError as error:
            self._note(element, str(error), port)
            return None

    def _key(self, element: Element, tag: str, values: dict[str, str] | None) -> str | None:
        """Return its key in the short form; None if it cannot have these children."""
        count, category = len(element.children), self._library.nodes[tag].category
        if category in ("Action", "Condition") and count:
            self._note(element, f"has {_nodes(element)} in it, but a leaf cannot have nodes in it: put them next to it")
        elif category == "Decorator" and count != 1:
            self._note(element, f"has {_nodes(element)} in it; {self._one()}")
        elif category == "Control" and not count:
            self._note(element, "has no node in it; give it one at least")
        elif not tag.startswith("Parallel"):
            return self._library.nodes[tag].key
        elif values is not None:
            try:
                return self._library.parallel(tag, values, count)
            except ValueError as error:
                self._note(element, str(error))
        return None

    def _subtree(self, element: Element, spot: _Spot) -> ParsedNode | None:
        if "ID" not in element.attributes:
            self._note(element, "missing; give the name of a <BehaviorTree>", "ID")
            return None
        if element.children:
            self._note(element, f"has {_nodes(element)} in it; they belong in the <BehaviorTree> of that name")
        name = element.attributes["ID"]
        if name not in self._document.trees:
            self._note(element, f"there is no tree {found_text(name)}{did_you_mean(name, self._document.trees):.200}")
            return None
        if name in spot.trees:
            ring = " -> ".join((*spot.trees[spot.trees.index(name) :], name))
            self._note(element, f"the tree would contain itself ({ring:.200}); remove one of the <SubTree> nodes")
            return None
        board = self._board(element, name, spot.board)
        uses = (*spot.uses, element.line)
        tree = self._tree(name, _Spot(board, (*spot.trees, name), uses, spot.depth + 1))
        called = _name(element, name) if self._library.subject.named else None
        if tree is None or called is None:
            return tree
        # The paths of its leaves contain its name, as with any other parent node.
        return ParsedNode(origin(element, spot.uses), "parallel", called, children=[tree])

    def _board(self, element: Element, name: str, above: Board) -> Board:
        """Return the entries of a subtree: its attributes, the defaults of its model, and all entries of the tree above
        if requested."""
        model = self._document.models.get(name)
        try:
            remapped = blackboard.autoremap(element)
        except ValueError as error:
            self._note(element, str(error), "_autoremap")
            remapped = False
        board = dict(above) if remapped else {}
        known = self._known(name)
        for attribute, value in element.attributes.items():
            if attribute in ("ID", "name", "_autoremap") or attribute in IGNORED:
                continue
            if attribute in SCRIPTS:
                self._note(element, self._library.no_scripts, attribute)
                continue
            if known is not None and attribute not in known:
                hint = did_you_mean(attribute, sorted(known)) if known else "; it reads none"
                self._note(element, f"the tree reads no such entry{hint:.200}", attribute)
            board[attribute] = self._resolved(element, attribute, value, above)
        for port, default in model.ports.items() if model is not None else ():
            if port in element.attributes or (remapped and port in above):
                continue
            if default is None:
                self._note(element, "missing; its <TreeNodesModel> has no default for it", port)
            board[port] = self._resolved(element, port, default, above) if default is not None else None
        return board

    def _known(self, name: str) -> set[str] | None:
        """Return the entries that a tree can receive; None if they cannot be determined."""
        if name not in self._read:
            read = blackboard.used(self._document.trees[name])
            if read is not None:
                models = self._document.models
                read |= models[name].ports.keys() if name in models else set()
                read = read.union(*(model.entries() for model in models.values()))
            self._read[name] = read
        return self._read[name]

    def _one(self) -> str:
        return f"give it one, such as a <{self._library.group}> with the others in it"

    def _no_text(self, element: Element) -> None:
        if element.texts:
            self._note(
                element, f"found the text {found_text(element.texts[0])} in it; values are written as attributes"
            )

    def _note(self, element: Element, message: str, attribute: str = "") -> None:
        self.problems.append(origin(element).problem(self._path, message, attribute))


def _name(element: Element, default: str) -> str | None:
    """Return the name that the author gave to a node, as opposed to the name that BehaviorTree.CPP assigns."""
    name = element.attributes.get("name")
    return name if name != default else None


def _nodes(element: Element) -> str:
    count = len(element.children)
    return "no node" if not count else "a node" if count == 1 else f"{count} nodes"
