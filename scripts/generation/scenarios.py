"""The library of OpenSCENARIO 2 that trees import, from what leaves and steps declare, and the tables of it in the pages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

from understudy.trees.languages.btcpp import steps as xml
from understudy.trees.languages.btcpp.xml_elements import Element, parse
from understudy.trees.languages.osc.library import (
    ACTIONS,
    COMPOSITIONS,
    ENUMS,
    MODIFIERS,
    RATES,
    STANDARD,
    Argument,
    Behavior,
)
from understudy.trees.languages.osc.steps import DECORATORS, LOOKS, PROCEDURES, STEPS
from understudy.trees.languages.osc.units import OWN, UNITS
from understudy.trees.leaves import procedure_vocabulary
from understudy.trees.leaves.registry import ADDED

_HEADER = f"""\
# What health trees (docs/trees-osc.md) and procedures (docs/procedures.md) can have: actions are leaves, modifiers stand in the with:
# of a node. Written by scripts/generate from operator/understudy/trees and those pages: change those.

import {STANDARD}
"""

_ACTIONS = {name: action for name, action in ACTIONS.items() if name not in ADDED}
"""What other packages that are installed here bring is no part of the library."""

_RATES: Mapping[str, str] = {
    "rate_above": "the rate is more than this",
    "rate_min": "the rate is at least this; may be together with rate_max",
    "rate_below": "the rate is less than this",
    "rate_max": "the rate is at most this; may be together with rate_min",
}

_ABOUT: Mapping[str, str] = {
    "inverter": "holds when its node fails",
    "while": "its node counts only while a goal of an action is active",
    "timeout": "fails when its node isn't done in time",
    "retry": "tries its node again after a failure",
}


def library(page: str, procedures: str) -> str:
    """The text of the library; ``page`` is the one that describes the leaves, ``procedures`` that of the steps."""
    about, ports = purposes(page, procedures), {**models(page), **models(procedures)}
    parts = [_HEADER]
    parts += [f"enum {name}: [{', '.join(members)}]\n" for name, members in ENUMS.items()]
    parts += [_type(name) for name in OWN]
    for title, word, behaviors in (
        ("Leaves of health trees, most of which procedures have too.", "action", _ACTIONS),
        ("Steps of procedures.", "action", STEPS),
        ("What procedures and readiness checks look at once.", "action", LOOKS),
        ("Of health trees; inverter() of procedures too.", "modifier", MODIFIERS),
        ("Of procedures.", "modifier", DECORATORS),
    ):
        parts.append(f"# {title}\n")
        for name, behavior in behaviors.items():
            parts.append(
                _behavior(f"{word} {name}", behavior, about.get(behavior.key, ""), ports.get(behavior.tag, {}))
            )
    return "\n".join(parts)


def purposes(page: str, procedures: str) -> dict[str, str]:
    """What every leaf, step and look is for, by its key, as the tables of the two pages begin to say it."""
    rows = re.findall(r"^\| `([a-z_]+)` \| (while .*?) \|", page, re.MULTILINE)
    return {key: f"holds {told.replace('`', '')}" for key, told in rows} | _done(procedures) | _ABOUT


def models(page: str) -> dict[str, dict[str, Element]]:
    """The ports of the nodes that a page shows the models of."""
    (shown,) = re.findall(r"```xml\n(<TreeNodesModel>.*?)```", page, re.DOTALL)
    return {
        model.attributes["ID"]: {port.attributes["name"]: port for port in model.children}
        for model in parse(shown).children
    }


def _done(page: str) -> dict[str, str]:
    """What steps and looks are for, as the tables of their page begin to say it."""
    described, _, _ = page.partition(PROCEDURES_BEGIN)
    rows = re.findall(r"^\| ((?:`[a-z_]+`(?:, )?)+) \| (.*) \|$", described, re.MULTILINE)
    told = {key: text for keys, text in rows for key in re.findall("[a-z_]+", keys)}
    return {key: re.split("[;.(]", told[key])[0].replace("`", "").strip() for key in (*STEPS, *LOOKS)}


BEGIN = "<!-- behaviours: written by scripts/generate from the leaves -->"
END = "<!-- end of behaviours -->"


def table() -> str:
    """Every behaviour with its arguments, as a table for the page about the language."""
    lines = ["| behaviour | in the short form | arguments, in their order |", "| --- | --- | --- |"]
    for behaviors, where in ((_ACTIONS, ""), (MODIFIERS, ", in a `with:`")):
        for name, behavior in behaviors.items():
            short = f"`{behavior.key}`"
            if behavior.arguments:
                short = f"[{short}](trees.md#{behavior.key})"
            arguments = ", ".join(_told(behavior, argument) for argument in behavior.arguments.values())
            lines.append(f"| `{name}()`{where} | {short} | {arguments} |")
    return "\n".join(lines)


def _told(behavior: Behavior, argument: Argument) -> str:
    """An argument, with its key where that is called otherwise and not just more shortly."""
    key = argument.where.rpartition(".")[2]
    told = f"`{argument.name}`"
    return told if key in argument.name or argument.name in RATES else f"{told}, which is the `{key}`"


def _type(name: str) -> str:
    lines = [f"type {name} is SI(s: -1)"]
    lines += [
        f"unit {unit} of {name} is SI(s: -1, factor: {_number(known.factor)})" for unit, known in UNITS[name].items()
    ]
    return "\n".join(lines) + "\n"


def _number(factor: Fraction) -> str:
    return str(factor.numerator) if factor.denominator == 1 else str(float(factor))


def _behavior(head: str, behavior: Behavior, about: str, ports: Mapping[str, Element]) -> str:
    comment = f"    # {about}\n" if about else ""
    if not behavior.arguments:
        return f"{head}\n{comment}"
    lines = [_argument(argument, ports.get(argument.port)) for argument in behavior.arguments.values()]
    return f"{head}:\n{comment}" + "\n".join(lines) + "\n"


def _default(type_: str, default: str) -> str:
    if type_ in ENUMS:
        return f"{type_}!{default}"
    return f'"{default}"' if type_ == "string" else default


def _argument(argument: Argument, port: Element | None) -> str:
    declared = f"{argument.name}: {argument.type}"
    default = port.attributes.get("default") if port is not None else None
    if default:
        declared += f" = {_default(argument.type, default)}"
    told = _RATES.get(argument.name) if argument.name in RATES else " ".join(port.texts) if port is not None else None
    return f"    {declared:<30} # {told}" if told else f"    {declared}"


PROCEDURES_BEGIN = "<!-- languages: written by scripts/generate from the steps -->"
PROCEDURES_END = "<!-- end of languages -->"


def languages() -> str:
    """Every node of procedures in the three languages, as a table for the page about them."""
    own = {key: tag for tag, node in xml.PROCEDURES.nodes.items() if (key := node.key) not in ACTIONS}
    tags = {**own, "sequence": "Sequence", "selector": "Fallback"}  # and not what means the same
    operators = {key: f"`{operator}:`" for operator, key in COMPOSITIONS.items()}
    lines = ["| in the short form | in XML | in OpenSCENARIO 2 |", "| --- | --- | --- |"]
    for key in (
        "sequence",
        "parallel",
        "selector",
        "inverter",
        *DECORATORS,
        *procedure_vocabulary.STEPS,
        *procedure_vocabulary.LOOKS,
    ):
        node = xml.PROCEDURES.nodes[tags[key]]
        ports = _listed([port for port, where in node.ports.items() if where])
        scenario = operators.get(key)
        if scenario is None:
            where = " in a `with:`" if key in PROCEDURES.modifiers else ""
            behavior = PROCEDURES.modifiers.get(key) or PROCEDURES.actions[key]
            scenario = f"`{key}()`{where}{_listed(list(behavior.arguments))}"
        lines.append(f"| `{key}` | `<{tags[key]}>`{ports} | {scenario} |")
    return "\n".join(lines)


def _listed(names: list[str]) -> str:
    return f": {', '.join(f'`{name}`' for name in names)}" if names else ""
