"""Writes procedures of the short form as BehaviorTree.CPP XML and as OpenSCENARIO 2."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any
from xml.sax.saxutils import quoteattr

from understudy.api.base import seconds

TAGS = {"sequence": "Sequence", "parallel": "Parallel", "selector": "Fallback"}
OPERATORS = {"sequence": "serial", "parallel": "parallel", "selector": "one_of"}
SCENARIO_NAMES = {
    "topic": "topic_name",
    "service": "service_name",
    "only": "names",
    ("parameter_is", "name"): "parameter",
    ("topic", "name"): "topic_name",
    ("call_service", "type"): "service_type",
    "type": "topic_type",
}
TIMES = ("repeat", "within", "gap")


def as_xml(tree: Mapping[str, Any]) -> str:
    """One file with one tree."""
    return f'<root BTCPP_format="4">\n<BehaviorTree ID="Main">\n{_element(tree)}\n</BehaviorTree>\n</root>\n'


def _element(node: Mapping[str, Any]) -> str:
    ((kind, value),) = node.items()
    if kind in TAGS:
        inside = "\n".join(_element(child) for child in value)
        return f"<{TAGS[kind]}>\n{inside}\n</{TAGS[kind]}>"
    if kind == "inverter":
        return f"<Inverter>\n{_element(value)}\n</Inverter>"
    if kind == "timeout":
        milliseconds = round(seconds(value["within"]) * 1000)
        return f'<Timeout msec="{milliseconds}">\n{_element(value["do"])}\n</Timeout>'
    if kind == "retry":
        wait = f" wait={quoteattr(value['wait'])}" if "wait" in value else ""
        return f'<RetryUntilSuccessful num_attempts="{value["times"]}"{wait}>\n{_element(value["do"])}\n</RetryUntilSuccessful>'
    tag = "".join(part.capitalize() for part in kind.split("_"))
    ports = {"parameter" if kind == "parameter_is" and key == "name" else key: one for key, one in value.items()}
    if kind == "topic":
        ports["topic"] = ports.pop("name")
    return f"<{tag}{''.join(f' {port}={quoteattr(_port(port, one))}' for port, one in ports.items())}/>"


def _port(port: str, value: Any) -> str:
    if port == "only":
        return ";".join(value)
    return value if isinstance(value, str) and port != "value" else f"json:{json.dumps(value)}"


def as_scenario(tree: Mapping[str, Any]) -> str:
    """One file with one scenario."""
    first, *rest = _lines(tree, 1, [])
    return "\n".join(["import osc.understudy", "scenario main:", f"    do {first.strip()}", *rest, ""])


def _lines(node: Mapping[str, Any], depth: int, modifiers: list[str]) -> list[str]:
    indent = "    " * depth
    ((kind, value),) = node.items()
    if kind == "inverter":
        return _lines(value, depth, [*modifiers, "inverter()"])
    if kind == "timeout":
        return _lines(value["do"], depth, [*modifiers, f"timeout({value['within']})"])
    if kind == "retry":
        pause = f", pause: {value['wait']}" if "wait" in value else ""
        return _lines(value["do"], depth, [*modifiers, f"retry({value['times']}{pause})"])
    block = [f"{indent}    {modifier}" for modifier in modifiers]
    if kind in OPERATORS:
        inside = [line for child in value for line in _lines(child, depth + 1, [])]
        return [f"{indent}{OPERATORS[kind]}:", *inside, *([f"{indent}with:", *block] if block else [])]
    arguments = ", ".join(f"{_name(kind, key)}: {_argument(key, one)}" for key, one in value.items())
    return [f"{indent}{kind}({arguments}){' with:' if block else ''}", *block]


def _name(kind: str, key: str) -> str:
    return SCENARIO_NAMES.get((kind, key)) or SCENARIO_NAMES.get(key, key)


def _argument(key: str, value: Any) -> str:
    if key in TIMES:
        return str(value)
    if key == "state":
        return f"lifecycle_state!{value}"
    if key == "only":
        value = ", ".join(value)
    elif not isinstance(value, str) or key == "value":
        value = json.dumps(value)
    return '"' + re.sub(r"([\\\"'])", r"\\\1", value) + '"'
