"""Writes the declarations of leaves and steps as the OpenSCENARIO 2 library, and as tables and XML models in the pages
about trees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from xml.sax.saxutils import escape, quoteattr

from understudy.trees.languages.btcpp import steps as xml
from understudy.trees.languages.btcpp.library import NODES, Node, tag_of
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
from understudy.trees.languages.osc.steps import CONDITIONS, DECORATORS, PROCEDURES, STEPS
from understudy.trees.languages.osc.units import OWN, UNITS
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.leaf_plan import Key
from understudy.trees.leaves.registry import LEAVES, PLUGINS

_HEADER = f"""\
# What health trees (docs/trees-osc.md) and procedures (docs/procedures.md) can have: actions are leaves, modifiers stand in the with:
# of a node. Written by scripts/generate from operator/understudy/trees/leaves: change those.

import {STANDARD}
"""

_ACTIONS = {name: action for name, action in ACTIONS.items() if name not in PLUGINS}
"""Leaves of other installed packages are not part of the library."""

_RATES: Mapping[str, str] = {
    "rate_above": "the rate is more than this",
    "rate_min": "the rate is at least this; may be together with rate_max",
    "rate_below": "the rate is less than this",
    "rate_max": "the rate is at most this; may be together with rate_min",
}

_AROUND: Mapping[str, tuple[str, tuple[Key, ...]]] = {
    "inverter": ("holds when its node fails", ()),
    "while": (
        "its node counts only while a goal of an action is active",
        (
            Key("task_active.action", "the action, fully qualified, such as /navigate_to_pose", xml="action"),
            Key("task_active.type", "package/action/Name", xml="type"),
            Key("settle", "how long it may take to start after the goal became active", "time", default="2s"),
        ),
    ),
    "timeout": (
        "fails when its node is not done in time",
        (Key("within", "how long it may take", "time", xml="msec"),),
    ),
    "retry": (
        "tries its node again after a failure",
        (
            Key("times", "how often it is tried", "int", xml="num_attempts"),
            Key("wait", "the time after a failure until it is tried again", "time", default="1s"),
        ),
    ),
}
"""The nodes that wrap others, which no leaf declares."""


def summary_of(kind: str) -> str:
    """Return one clause about a leaf, step or decorator."""
    if kind in LEAVES:
        return f"holds {LEAVES[kind].summary}"
    if kind in _AROUND:
        return _AROUND[kind][0]
    return {**procedure_leaves.STEPS, **procedure_leaves.CONDITIONS}[kind].summary


def keys_of(kind: str) -> Mapping[str, Key]:
    """Return the keys of a leaf, step or decorator, by their paths in the short form."""
    if kind == "while":
        return {("" if key.name == "settle" else "while.") + key.name: key for key in _AROUND[kind][1]}
    if kind in _AROUND:
        return {f"{kind}.{key.name}": key for key in _AROUND[kind][1]}
    declared = {**LEAVES, **procedure_leaves.STEPS, **procedure_leaves.CONDITIONS}[kind].arguments
    return {f"{kind}.{key.name}": key for key in declared}


def library() -> str:
    """Return the text of the library."""
    parts = [_HEADER]
    parts += [f"enum {name}: [{', '.join(members)}]\n" for name, members in ENUMS.items()]
    parts += [_type(name) for name in OWN]
    for title, word, behaviors in (
        ("Leaves of health trees, most of which procedures have too.", "action", _ACTIONS),
        ("Steps of procedures.", "action", STEPS),
        ("What procedures and readiness checks look at once.", "action", CONDITIONS),
        ("Of health trees; inverter() of procedures too.", "modifier", MODIFIERS),
        ("Of procedures.", "modifier", DECORATORS),
    ):
        parts.append(f"# {title}\n")
        parts += [_behavior(f"{word} {name}", behavior) for name, behavior in behaviors.items()]
    return "\n".join(parts)


# -- docs/trees.md ----------------------------------------------------------------------------------------------------

LEAVES_BEGIN = "<!-- leaves: written by scripts/generate from the leaves -->"
LEAVES_END = "<!-- end of leaves -->"
TAGS_BEGIN = "<!-- tags: written by scripts/generate from the leaves -->"
TAGS_END = "<!-- end of tags -->"
MODELS_BEGIN = "<!-- models: written by scripts/generate from the leaves and steps -->"
MODELS_END = "<!-- end of models -->"

_OWN_LEAVES = {name: leaf for name, leaf in LEAVES.items() if name not in PLUGINS}


def leaf_table() -> str:
    """Return the leaves of health trees with when they hold, as a table."""
    rows = [f"| `{name}` | {leaf.summary} | see [below](#{name}) |" for name, leaf in _OWN_LEAVES.items()]
    return "\n".join(["| leaf | holds | value |", "| --- | --- | --- |", *rows])


def tag_table() -> str:
    """Return the leaves of health trees as XML writes them, as a table."""
    lines = ["| leaf | in the short form | ports |", "| --- | --- | --- |"]
    for name, leaf in _OWN_LEAVES.items():
        ports = ", ".join(
            f"`{key.port}`" if key.port == key.name else f"`{key.port}`, which is the `{key.name}`"
            for key in leaf.arguments
        )
        lines.append(f"| `<{tag_of(name)}>` | `{name}` | {ports} |")
    return "\n".join(lines)


def health_models() -> str:
    """Return the models of the nodes of health trees, for Groot 2."""
    return _models(
        {tag_of(name): NODES[tag_of(name)] for name in _OWN_LEAVES} | {"WhileTaskActive": NODES["WhileTaskActive"]}
    )


def step_models() -> str:
    """Return the models of the nodes that only procedures have, for Groot 2."""
    own = {
        tag_of(key): xml.PROCEDURES.nodes[tag_of(key)]
        for key in (*procedure_leaves.STEPS, *procedure_leaves.CONDITIONS)
    }
    around = {tag: node for tag, node in xml.PROCEDURES.nodes.items() if node.key in ("timeout", "retry")}
    return _models(own | around)


def _models(nodes: Mapping[str, Node]) -> str:
    lines = ["```xml", "<TreeNodesModel>"]
    for tag, node in nodes.items():
        keys = list(keys_of(node.key).values())
        if not keys:
            lines.append(f'  <{node.category} ID="{tag}"/>')
            continue
        lines += [f'  <{node.category} ID="{tag}">', *_ports(keys), f"  </{node.category}>"]
    return "\n".join([*lines, "</TreeNodesModel>", "```"])


def _ports(keys: Sequence[Key]) -> list[str]:
    return [
        f'    <input_port name="{key.port}"{f" default={quoteattr(key.default)}" if key.default else ""}>{escape(key.about)}</input_port>'
        for key in keys
    ]


# -- docs/trees-osc.md ------------------------------------------------------------------------------------------------

BEGIN = "<!-- behaviours: written by scripts/generate from the leaves -->"
END = "<!-- end of behaviours -->"


def table() -> str:
    """Return every behaviour with its arguments, as a table for the page about the language."""
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
    """Describe an argument, with its key if the argument's name does not contain the key."""
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


def _behavior(head: str, behavior: Behavior) -> str:
    comment = f"    # {summary_of(behavior.key)}\n"
    if not behavior.arguments:
        return f"{head}\n{comment}"
    keys = keys_of(behavior.key)
    lines = [_argument(argument, keys[argument.where]) for argument in behavior.arguments.values()]
    return f"{head}:\n{comment}" + "\n".join(lines) + "\n"


def _default(type_: str, default: str) -> str:
    if type_ in ENUMS:
        return f"{type_}!{default}"
    return f'"{default}"' if type_ == "string" else default


def _argument(argument: Argument, key: Key) -> str:
    declared = f"{argument.name}: {argument.type}"
    if key.default:
        declared += f" = {_default(argument.type, key.default)}"
    return f"    {declared:<30} # {_RATES.get(argument.name, key.about)}"


# -- docs/procedures.md -----------------------------------------------------------------------------------------------

PROCEDURES_BEGIN = "<!-- languages: written by scripts/generate from the steps -->"
PROCEDURES_END = "<!-- end of languages -->"


def languages() -> str:
    """Return every node of procedures in the three languages, as a table for the page about them."""
    own = {key: tag for tag, node in xml.PROCEDURES.nodes.items() if (key := node.key) not in ACTIONS}
    tags = {**own, "sequence": "Sequence", "selector": "Fallback"}  # not the tags that mean the same
    operators = {key: f"`{operator}:`" for operator, key in COMPOSITIONS.items()}
    lines = ["| in the short form | in XML | in OpenSCENARIO 2 |", "| --- | --- | --- |"]
    for key in (
        "sequence",
        "parallel",
        "selector",
        "inverter",
        *DECORATORS,
        *procedure_leaves.STEPS,
        *procedure_leaves.CONDITIONS,
    ):
        node = xml.PROCEDURES.nodes[tags[key]]
        ports = _listed([port for port, where in node.ports.items() if where])
        scenario = operators.get(key)
        if scenario is None:
            where = " in a `with:`" if key in PROCEDURES.modifiers else ""
            behavior = PROCEDURES.modifiers.get(key) or PROCEDURES.actions[key]
            scenario = f"`{key}()`{where}{_listed(list(behavior.arguments))}"
        lines.append(f"| `{key}` | `<{tags[key]}>`{ports} | {scenario} |")
    leaves = ", ".join(f"`{name}`" for name, leaf in _OWN_LEAVES.items() if not leaf.active_only)
    lines += ["", f"The leaves of health trees are written [as there](trees.md#behaviortreecpp-xml): {leaves}."]
    return "\n".join(lines)


def _listed(names: list[str]) -> str:
    return f": {', '.join(f'`{name}`' for name in names)}" if names else ""
