"""Writes trees of the short form as OpenSCENARIO 2, in whichever of the ways there are."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from understudy.api.base import seconds
from understudy.trees.languages.osc.library import ACTIONS, COMPOSITIONS, MODIFIERS, RATES, Argument, Behavior
from understudy.trees.languages.osc.units import UNITS

Choose = Callable[[int], int]
"""One of so many, from 0."""

OPERATORS = {key: operator for operator, key in COMPOSITIONS.items()}
TASK = MODIFIERS["while_task_active"]


def first(count: int) -> int:
    """Always the plainest way."""
    return 0


class ScenarioWriter:
    """Writes one file; a choice decides for each value whether it becomes a parameter of the scenario."""

    def __init__(self, choose: Choose = first) -> None:
        self._choose = choose
        self._parameters: list[str] = []

    def file(self, tree: Mapping[str, Any]) -> str:
        """The whole file."""
        lines = self._node(tree, 1 + self._choose(4), [])
        indent = " " * self._indent(lines[0])
        lines[0] = f"{indent}do {lines[0].strip()}"
        head = ["import osc.understudy"] + ["import osc.types"] * self._choose(2)
        head = ["# why"] * self._choose(2) + head + [""] * self._choose(3)
        return "\n".join([*head, "scenario healthy:", *(f"{indent}{line}" for line in self._parameters), *lines, ""])

    @staticmethod
    def _indent(line: str) -> int:
        return len(line) - len(line.lstrip())

    def _node(self, node: Mapping[str, Any], indent: int, modifiers: list[str]) -> list[str]:
        if "name" in node and ("inverter" in node or "while" in node):
            # A modifier has no name; that of a composition counts as much in a leaf's.
            inner = {key: value for key, value in node.items() if key != "name"}
            return self._node({"name": node["name"], "sequence": [inner]}, indent, modifiers)
        if "inverter" in node:
            return self._node(node["inverter"], indent, [*modifiers, "inverter()"])
        if "while" in node:
            condition = {"while": node["while"], **({"settle": node["settle"]} if "settle" in node else {})}
            call = f"while_task_active({self._arguments(TASK, condition)})"
            return self._node(node["do"], indent, [*modifiers, call])
        begin = " " * indent
        label = f"{begin}{self._label(node['name'])}: " if "name" in node else begin
        deeper = indent + 1 + self._choose(4)
        for kind, action in ACTIONS.items():
            if kind in node:
                line = f"{label}{kind}({self._arguments(action, node)})"
                if not modifiers:
                    return [line + ("  # why" if self._choose(4) == 3 else "")]
                return [f"{line} with:", *(" " * deeper + modifier for modifier in modifiers)]
        ((key, operator),) = ((key, operator) for key, operator in OPERATORS.items() if key in node)
        lines = [f"{label}{operator}:"]
        for child in node[key]:
            lines += [""] * (self._choose(8) == 7) + self._node(child, deeper, [])
        return lines + ([f"{begin}with:", *(" " * deeper + modifier for modifier in modifiers)] if modifiers else [])

    def _label(self, name: str) -> str:
        plain = re.fullmatch("[A-Za-z][A-Za-z0-9_]*", name) and self._choose(2) == 0
        return name if plain else f"|{name}|"

    def _arguments(self, behavior: Behavior, node: Mapping[str, Any]) -> str:
        arguments: dict[str, str] = {}
        for argument in behavior.arguments.values():
            value: Any = node
            for key in argument.where.split("."):
                value = value.get(key) if isinstance(value, Mapping) else None
            if value is None:
                continue
            text = self._rate(argument, value) if argument.name in RATES else self._value(argument.type, value)
            if text is not None:
                arguments[argument.name] = self._parameter(argument.type, text)
        names = list(behavior.arguments)
        count = 0
        while count < len(arguments) and names[count] in arguments and self._choose(2) == 1:
            count += 1
        parts = [arguments.pop(name) for name in names[:count]] + [
            f"{name}: {value}" for name, value in arguments.items()
        ]
        return (", ", ",\n\n   ")[self._choose(5) == 4].join(parts)

    def _parameter(self, type_: str, text: str) -> str:
        if self._choose(6) != 5:
            return text
        name = f"given{len(self._parameters)}"
        self._parameters.append(f"{name}: {type_} = {text}")
        return name

    def _rate(self, argument: Argument, band: str) -> str | None:
        """The bound of a band that an argument is."""
        if (between := re.fullmatch(r"(\S+) to (\S+) Hz", band)) is not None:
            bounds = {"rate_min": between[1], "rate_max": between[2]}
        else:
            sign, bound, _ = band.split()
            bounds = {name: bound for name in RATES if RATES[name] == sign}
        return f"{bounds[argument.name]}{('Hz', 'hertz')[self._choose(2)]}" if argument.name in bounds else None

    def _value(self, type_: str, value: Any) -> str:
        if type_ == "time":
            names = list(UNITS["time"])
            name = names[self._choose(len(names))]
            amount = seconds(value) / float(UNITS["time"][name].factor)
            exact = f"{amount:.9f}".rstrip("0").rstrip(".")
            unit = UNITS["time"][name]
            if seconds(f"{exact}{unit.short}") == seconds(value) and exact != "0":
                return f"{exact}{name}"
            return f"{seconds(value) * 1000:.9f}".rstrip("0").rstrip(".") + "ms"
        if type_ == "string":
            quote = "\"'"[self._choose(2)]
            # Inside of a text each quote has a backslash, also that of the other kind.
            return quote + re.sub(r"([\\\"'])", r"\\\1", str(value)) + quote
        return str(value) if type_ in ("int", "float") else f"{type_}!{value}"
