"""Builds the reference page of leaves from their declarations, and from the errors of the loader for an empty leaf."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from typing import Any

from scripts.generation import scenarios
from understudy.trees.languages.btcpp import steps as xml
from understudy.trees.languages.btcpp.library import NODES
from understudy.trees.languages.osc.library import ACTIONS, ENUMS, MODIFIERS, Argument, Behavior
from understudy.trees.languages.osc.steps import CONDITIONS, DECORATORS, STEPS, WATCHED
from understudy.trees.languages.short.health_loader import load
from understudy.trees.languages.short.procedure_loader import load_procedure
from understudy.trees.languages.text.flow_values import structure_of
from understudy.trees.languages.text.step_values import names_of
from understudy.trees.leaves.leaf_plan import Key
from understudy.trees.source.problems import Problem, TreeError

_INTRODUCTION = """\
# Leaves, steps and what stands around them

<!-- Written by scripts/generate from operator/understudy/trees/leaves: change those. -->

Everything that [health trees](../trees.md) and [procedures](../procedures.md) can have with values of its own, in all three languages. What
only holds other nodes is on those pages.

- A **duration** is a number with `ms`, `s`, `m` or `h`, such as `500ms`. In OpenSCENARIO 2 it has that language's units (`ms`, `s`,
  `min`, `h`), and in XML the `msec` of a `<Timeout>` is a number of milliseconds, as BehaviorTree.CPP has it.
- A **rate** is a band in Hz, such as `> 8 Hz` or `9 to 11 Hz`; in OpenSCENARIO 2 each bound is an argument, with `Hz` or `kHz`.
- A **structure** is whatever YAML can say, such as `{data: true}`; XML and OpenSCENARIO 2 have that in a text. A **list of names** is
  a text there too, with `;` between them.
- Numbers with other units are texts with the unit in it, such as `0.5 m/s2`.
- Where no default stands, the value is left out of what is judged or done, or follows from the others, as the page of the tree says."""

_TYPES: Mapping[str, str] = {
    "time": "duration",
    "frequency": "rate",
    "string": "text",
    "int": "whole number",
    "float": "number",
    **{name: " \\| ".join(f"`{member}`" for member in members) for name, members in ENUMS.items()},
}
"""The names of argument types on the page."""

_READ: Mapping[Callable[[str], Any] | None, str] = {structure_of: "structure", names_of: "list of names"}
"""The names of types whose values are texts in other languages."""

_DRIVEN = {"topic": {"name": "/cmd_vel", "gap": "1s"}}
"""An example leaf, for nodes that must contain one."""


_TAGS: Mapping[str, str] = {
    **{node.key: tag for tag, node in xml.PROCEDURES.nodes.items()},
    **{node.key: tag for tag, node in NODES.items()},
}
"""The name of each node in XML."""


def page() -> str:
    """Return the whole page as Markdown."""
    lines = [_INTRODUCTION]
    for title, explained, behaviors in (
        ("Leaves of health trees", "trees.md", ACTIONS),
        ("Around nodes of health trees", "trees.md", {k: v for k, v in MODIFIERS.items() if v.arguments}),
        ("Steps of procedures", "procedures.md", STEPS),
        ("What procedures and readiness checks look at once", "procedures.md", CONDITIONS),
        ("Around nodes of procedures", "procedures.md", DECORATORS),
    ):
        lines += ["", f"## {title}"]
        for name, behavior in behaviors.items():
            anchor = behavior.key if explained == "trees.md" else "nodes"
            about = scenarios.summary_of(behavior.key)
            lines += ["", f"### {behavior.key}", ""]
            lines.append(
                f"{about[0].upper()}{about[1:]}. `<{_TAGS[behavior.key]}>` in XML, `{name}()` in OpenSCENARIO 2"
                f"{', in a `with:`' if name in MODIFIERS or name in DECORATORS else ''}"
                f"{'; procedures have it too' if name in WATCHED else ''}. [More](../{explained}#{anchor})."
            )
            lines += _values(behavior)
    return "\n".join(lines) + "\n"


def _values(behavior: Behavior) -> Iterator[str]:
    """Yield the table of a node's values, and what is refused if none is given."""
    if not behavior.arguments:
        return
    lacks = {problem.path: problem.message for problem in _given_nothing(behavior.key)}
    keys = scenarios.keys_of(behavior.key)
    yield ""
    yield "| short form | XML | OpenSCENARIO 2 | type | default | |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for where, group in groupby(behavior.arguments.values(), key=lambda argument: argument.where):
        arguments, key = list(group), keys[where]
        names = ", ".join(f"`{argument.name}`" for argument in arguments)
        cells = [
            f"`{where.removeprefix(f'{behavior.key}.')}`",
            f"`{key.port}`",
            names,
            _type(arguments[0]),
            _default(key, f"spec.{where}" in lacks),
            key.about,
        ]
        yield f"| {' | '.join(cells)} |"
    if others := lacks.get(f"spec.{behavior.key}"):
        yield ""
        yield f"Without values: {others}."


def _type(argument: Argument) -> str:
    return _READ.get(argument.reads) or _TYPES[argument.type]


def _default(key: Key, required: bool) -> str:
    return "required" if required else f"`{key.default}`" if key.default else ""


def _given_nothing(key: str) -> list[Problem]:
    """Return the problems that the loader reports for a node without any values."""
    try:
        if key == "while":
            load({"while": {"task_active": {}}, "do": _DRIVEN}, path="spec")
        elif key in ACTIONS:
            load({key: {}}, path="spec")
        else:
            load_procedure({key: {}}, path="spec")
    except TreeError as error:
        return error.problems
    return []
