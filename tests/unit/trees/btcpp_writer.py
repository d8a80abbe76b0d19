"""Writes trees of the short form as BehaviorTree.CPP XML, in whichever of the ways there are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from xml.sax.saxutils import quoteattr

Choose = Callable[[int], int]
"""One of so many, from 0."""

ALL = (
    "Parallel",
    "ParallelAll",
    'Parallel success_count="-1"',
    'Parallel success_count="{count}" failure_count="1"',
    'ParallelAll max_failures="1"',
    'Control ID="Parallel"',
)
ANY = ("Fallback", "ReactiveFallback", 'Control ID="Fallback"', 'Parallel success_count="1" failure_count="-1"')
IN_ORDER = ("Sequence", "ReactiveSequence", 'Control ID="ReactiveSequence"')
LEAVES = ("motion", "progress", "node", "transform")
"""Those that are written in one way alone."""

CONTROLS = {"parallel": ALL, "selector": ANY, "sequence": IN_ORDER}


def first(count: int) -> int:
    """Always the plainest way."""
    return 0


class Writer:
    """Writes one file; a choice decides for each part whether it becomes a separate tree."""

    def __init__(self, choose: Choose = first) -> None:
        self._choose = choose
        self._trees: list[str] = []

    def file(self, tree: Mapping[str, Any]) -> str:
        """The whole file."""
        main = self._tree(tree, "Main")
        trees = "\n".join([main, *self._trees] if self._choose(2) == 0 else [*self._trees, main])
        return f'<?xml version="1.0"?>\n<root BTCPP_format="4" main_tree_to_execute="Main">\n{trees}\n</root>\n'

    def _tree(self, tree: Mapping[str, Any], name: str, entries: Mapping[str, str] | None = None) -> str:
        return f"<BehaviorTree ID={quoteattr(name)}>\n{self._node(tree, entries or {})}\n</BehaviorTree>"

    def _node(self, node: Mapping[str, Any], entries: Mapping[str, str]) -> str:
        if self._choose(6) == 5:
            return self._subtree(node, entries)
        name = {"name": node["name"]} if "name" in node else {}
        if "topic" in node:
            fields = {"topic" if key == "name" else key: value for key, value in node["topic"].items()}
            return (
                f"<{('Topic', 'Condition ID=' + quoteattr('Topic'))[self._choose(2)]}{_ports(name | fields, entries)}/>"
            )
        for leaf in LEAVES:
            if leaf in node:
                fields = {leaf if key == "name" else key: value for key, value in _texts(node[leaf]).items()}
                return f"<{leaf.capitalize()}{_ports(name | fields, entries)}/>"
        if "inverter" in node:
            tag, children = ("Inverter", 'Decorator ID="Inverter"')[self._choose(2)], [node["inverter"]]
        elif "while" in node:
            fields = node["while"]["task_active"] | ({"settle": node["settle"]} if "settle" in node else {})
            tag, children = f"WhileTaskActive{_ports(fields, entries)}", [node["do"]]
        else:
            (key,) = (key for key in CONTROLS if key in node)
            children = node[key]
            tag = CONTROLS[key][self._choose(len(CONTROLS[key]))].format(count=len(children))
            if key == "selector" and len(children) == 1 and tag.startswith("Parallel"):
                tag = "Fallback"  # of one, <Parallel> is all of them
        inside = "\n".join(self._node(child, entries) for child in children)
        return f"<{tag}{_ports(name, {})}>\n{inside}\n</{tag.split()[0]}>"

    def _subtree(self, node: Mapping[str, Any], entries: Mapping[str, str]) -> str:
        """The node as a tree of its own that gets what it needs by name."""
        name = f"Tree{len(self._trees)}"
        place = len(self._trees)
        self._trees.append("")
        if self._choose(2) == 0 and entries:
            self._trees[place] = self._tree(node, name, entries)
            return f'<SubTree ID="{name}" _autoremap="true"/>'
        values = {f"value{index}": value for index, value in enumerate(_values(node))}
        below = {value: key for key, value in values.items()}
        self._trees[place] = self._tree(node, name, below)
        return f'<SubTree ID="{name}"{_ports(values, entries)}/>'


def _ports(fields: Mapping[str, str], entries: Mapping[str, str]) -> str:
    """Attributes; those whose value is an entry are given by that, but for names."""
    ports = {
        key: "{" + entries[value] + "}" if value in entries and key != "name" else value
        for key, value in fields.items()
    }
    return "".join(f" {key}={quoteattr(value)}" for key, value in ports.items())


def _texts(fields: Mapping[str, object]) -> dict[str, str]:
    return {key: str(value) for key, value in fields.items()}


def _values(node: Mapping[str, Any]) -> list[str]:
    """What the leaves and the situations of a tree were given, each once."""
    found: dict[str, None] = {}
    for key, value in node.items():
        if key in ("topic", "task_active", *LEAVES):
            found.update(dict.fromkeys(_texts(value).values()))
        elif isinstance(value, Mapping):
            found.update(dict.fromkeys(_values(value)))
        elif isinstance(value, list):
            found.update(dict.fromkeys(text for child in value for text in _values(child)))
        elif key == "settle":
            found[value] = None
    return list(found)
