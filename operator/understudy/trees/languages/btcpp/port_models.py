"""Reads <TreeNodesModel>: the ports of nodes and subtrees that the author of a text expects. Most often Groot 2 writes
it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from understudy.trees.languages.btcpp.blackboard import entry
from understudy.trees.languages.btcpp.library import Node
from understudy.trees.languages.btcpp.xml_elements import Element
from understudy.trees.source.problems import did_you_mean

PORTS = ("input_port", "output_port", "inout_port")

Note = Callable[[Element, str], None]
"""Records a mistake in an element."""


@dataclass
class SubTreeModel:
    """The ports of a subtree. A subtree with a model has no other ports."""

    ports: dict[str, str | None] = field(default_factory=dict)
    """The default of each port; None if the port is required."""

    def entries(self) -> set[str]:
        """Return the entries of the tree above that its defaults read."""
        found = set()
        for port, default in self.ports.items():
            with contextlib.suppress(ValueError):  # reported where it is used
                found.add(entry(default or "", port) or "")
        return found


def read(element: Element, nodes: Mapping[str, Node], note: Note) -> Mapping[str, SubTreeModel]:
    """Return the models of subtrees. Models of known ``nodes`` are compared with the nodes; all other models are
    ignored."""
    subtrees: dict[str, SubTreeModel] = {}
    for model in element.children:
        name = model.attributes.get("ID", "")
        if model.tag == "SubTree":
            subtrees[name] = SubTreeModel({_name(port): port.attributes.get("default") for port in _ports(model)})
        elif name in nodes:
            _compare(model, name, nodes[name], note)
    return subtrees


def _compare(model: Element, name: str, node: Node, note: Note) -> None:
    if model.tag != node.category:
        note(model, f'{name} is {node.a}; write <{node.category} ID="{name}">')
    for port in _ports(model):
        if _name(port) not in node.ports:
            note(port, f"{name} has no port {_name(port)!r}{_known(_name(port), node.ports)}")
        elif port.tag != "input_port":
            note(port, f"{_name(port)!r} of {name} is only read; write <input_port>")


def _known(name: str, ports: Mapping[str, str]) -> str:
    return did_you_mean(name, ports) if ports else "; it has none"


def _ports(model: Element) -> list[Element]:
    return [port for port in model.children if port.tag in PORTS]


def _name(port: Element) -> str:
    return port.attributes.get("name", "")
