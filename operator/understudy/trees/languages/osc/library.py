"""The actions and modifiers of a health tree in OpenSCENARIO 2, derived from the leaves of the short form.

Every leaf of the short form is an action here, with its keys as arguments. If a key is a word of the language, or is
ambiguous, the argument has the name that scenario-execution's own ROS library uses (``topic_name``, ``action_type``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.leaf_plan import Key
from understudy.trees.leaves.registry import LEAVES, REFUSED_PLUGINS

PACKAGE = "osc.understudy"
"""The name with which a policy imports the library."""

STANDARD = "osc.types"
"""The standard's types, which the library imports; a policy may import them too."""

ENUMS: Mapping[str, tuple[str, ...]] = {
    key.type: key.members for leaf in LEAVES.values() for key in leaf.arguments if key.members
}
"""The members of each enum."""

_WORDS = """
import type is SI unit of factor offset kg m s A K mol cd rad enum struct inherits actor scenario action modifier extend global
list int uint float bool string event if as rise fall elapsed every var sample with keep default hard remove_default on do serial
one_of parallel wait emit call until def expression undefined external only cover record range or and not in it true false
name associated_actor
"""

WORDS = frozenset(_WORDS.split())
"""The words of the language and those that scenario-execution reserves. No argument can have such a name."""

_SUBJECTS = ("topic", "action", "service")

RATES: Mapping[str, str] = {"rate_above": ">", "rate_min": ">=", "rate_below": "<", "rate_max": "<="}
"""The bounds of a rate, as arguments: OpenSCENARIO has units, but no texts such as ``> 8 Hz``."""


@dataclass(frozen=True)
class Argument:
    """An argument of an action or modifier."""

    name: str
    type: str
    """``string``, ``int``, ``float``, a physical type or an enum."""
    where: str
    """Path from the node to its value in the short form."""
    reads: Callable[[str], Any] | None = None
    """The parser of its value, if that is not a text in the short form. Raises ValueError."""


@dataclass(frozen=True)
class Behavior:
    """An action or a modifier."""

    key: str
    """Its key in the short form."""
    arguments: Mapping[str, Argument]
    """By name, in the order in which they can be given without a name."""


def behavior_of(kind: str, keys: Sequence[Key], reads: Mapping[str, Callable[[str], Any]] | None = None) -> Behavior:
    """Return the action for a leaf or step with these keys; ``reads`` has the parsers of texts, by the type of a
    key."""
    found: list[Argument] = []
    for key in keys:
        where = f"{kind}.{key.name}"
        if key.type == "frequency":
            found += [Argument(name, key.type, where) for name in RATES]
        else:
            read = (reads or {}).get(key.type)
            found.append(Argument(_name(kind, key, keys), "string" if read else key.type, where, read))
    return Behavior(kind, {argument.name: argument for argument in found})


def _name(kind: str, key: Key, keys: Sequence[Key]) -> str:
    if key.osc:
        return key.osc
    if key.port in _SUBJECTS:
        return f"{key.port}_name"
    if key.port == "type":
        return f"{next((one.port for one in keys if one.port in _SUBJECTS), kind)}_type"
    return f"{kind}_{key.port}" if key.port in WORDS else key.port


ACTIONS: Mapping[str, Behavior] = {kind: behavior_of(kind, leaf.arguments) for kind, leaf in LEAVES.items()}
"""The leaves as actions, by name."""

MODIFIERS: Mapping[str, Behavior] = {
    "inverter": Behavior("inverter", {}),
    "while_task_active": Behavior(
        "while",
        {
            "action_name": Argument("action_name", "string", "while.task_active.action"),
            "action_type": Argument("action_type", "string", "while.task_active.type"),
            "settle": Argument("settle", "time", "settle"),
        },
    ),
}
"""The modifiers for the ``with:`` of a node, by name."""

COMPOSITIONS: Mapping[str, str] = {"serial": "sequence", "parallel": "parallel", "one_of": "selector"}
"""The operators of the language and their keys in the short form."""

_STATUSES = ("failure", "running", "success")
STATUS_CHANGES = tuple(f"{one}_is_{other}" for one in _STATUSES for other in _STATUSES)
"""scenario-execution's names of the modifiers that convert one status into another."""

_ONCE = "a health tree is evaluated continuously; remove it, and give the leaf in it a longer gap or window"
_LATER = "gap, window, settle and the policy's debounce set how long something may be missing; remove it"
_CERTAIN = "a constant result, or none, says nothing about the robot; remove it"
_RECOVERY = "a health tree takes no action; actions after a failure belong in spec.strategies of the policy"
_STORE = "a health tree remembers and writes nothing; remove it"
_NO_PROCESSES = "a health tree starts no processes and reads no files; write what must hold, such as topic() or value()"
_CHECKS_ONLY = (
    "only procedures and checks test this once; in a health tree, write what must hold, such as lifecycle() or node()"
)

_OTHERS: Mapping[str, str] = {
    **REFUSED_PLUGINS,
    **dict.fromkeys(("run_process", "process_log_check"), _NO_PROCESSES),
    **dict.fromkeys(("increment", "decrement", "log"), _STORE),
    "compare": "values of messages are compared by value(); write that",
    "retry": _ONCE,
    "repeat": _ONCE,
    "timeout": _LATER,
    **dict.fromkeys(STATUS_CHANGES, _CERTAIN),
    "topic_monitor": "write topic()",
    "assert_topic_latency": "write age()",
    "wait_for_topics": "write topic(), or publisher() for a topic with rare messages",
    **dict.fromkeys(("check_data", "wait_for_data"), "write value()"),
    **dict.fromkeys(
        ("action_call", "service_call", "topic_publish", "set_node_parameter", "kubernetes_delete"), _RECOVERY
    ),
    "kubernetes_patch_network_policy": _RECOVERY,
    **dict.fromkeys(procedure_leaves.STEPS, _RECOVERY),
    **dict.fromkeys(procedure_leaves.CONDITIONS, _CHECKS_ONLY),
}

REFUSED: Mapping[str, str] = {name: why for name, why in _OTHERS.items() if name not in ACTIONS}
"""Why health trees cannot have other behaviours of scenario-execution, and what to use instead."""
