"""The actions and modifiers of a health tree in OpenSCENARIO 2, derived from the leaves that the short form has.

A leaf that is added there is an action here, with the arguments that its keys are. What they are called follows scenario-execution's
own ROS library (``topic_name``, ``action_type``) where the key is a word of the language or wouldn't say whose name it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.trees.languages.btcpp.library import NODES
from understudy.trees.languages.short.health_loader import TASK_KEYS, TOPIC_KEYS
from understudy.trees.leaves import procedure_vocabulary
from understudy.trees.leaves.age import CLOCKS
from understudy.trees.leaves.diagnostics import LEVELS
from understudy.trees.leaves.lifecycle import STATES
from understudy.trees.leaves.log import LEVELS as SEVERITIES
from understudy.trees.leaves.registry import LEAVES, UNUSABLE

PACKAGE = "osc.understudy"
"""How a policy imports the library."""

STANDARD = "osc.types"
"""The types of the standard, which the library imports; a policy may too."""

ENUMS: Mapping[str, tuple[str, ...]] = {
    "level": LEVELS[:3],
    "severity": tuple(SEVERITIES),
    "lifecycle_state": STATES,
    "age_by": CLOCKS,
}
"""The members of each enum."""

_WORDS = """
import type is SI unit of factor offset kg m s A K mol cd rad enum struct inherits actor scenario action modifier extend global
list int uint float bool string event if as rise fall elapsed every var sample with keep default hard remove_default on do serial
one_of parallel wait emit call until def expression undefined external only cover record range or and not in it true false
name associated_actor
"""

WORDS = frozenset(_WORDS.split())
"""The words of the language, and those that scenario-execution keeps for itself, which no argument can be called."""

_TYPES: Mapping[tuple[str, str], str] = {
    ("age", "most"): "time",
    ("age", "by"): "age_by",
    ("transform", "at_most"): "time",
    ("diagnostics", "worst"): "level",
    ("log", "level"): "severity",
    ("log", "quiet"): "time",
    ("progress", "by"): "float",
    ("progress", "within"): "time",
    ("lifecycle", "state"): "lifecycle_state",
    ("motion", "delay"): "time",
    ("pod", "restarts"): "int",
}
"""What keys are that only some leaves have."""

_SHARED: Mapping[str, str] = {**dict.fromkeys(("gap", "window", "for", "settle"), "time"), "count": "int"}
"""What keys are that mean the same in all leaves. All others are texts, which the short form reads as well as numbers."""

_SUBJECTS = ("topic", "action", "service")

RATES: Mapping[str, str] = {"rate_above": ">", "rate_min": ">=", "rate_below": "<", "rate_max": "<="}
"""The bounds of a rate: OpenSCENARIO has units, but no text such as ``> 8 Hz``."""


@dataclass(frozen=True)
class Argument:
    """An argument of an action or modifier."""

    name: str
    type: str
    """``string``, ``int``, ``float``, a physical type or an enum."""
    where: str
    """Where its value goes in the short form, as a path from the node."""
    port: str = ""
    """What it is in XML, where what it is for is said."""
    reads: Callable[[str], Any] | None = None
    """What reads its value, where that is no text in the short form. Raises ValueError."""


@dataclass(frozen=True)
class Behavior:
    """An action or a modifier."""

    key: str
    """What it is in the short form."""
    arguments: Mapping[str, Argument]
    """By name, in the order in which they can be given without it."""
    tag: str = ""
    """What it is in XML, where that is known."""


def _leaf(kind: str, keys: tuple[str, ...]) -> Behavior:
    tag = next((tag for tag, node in NODES.items() if node.key == kind and node.category == "Condition"), "")
    ports = {where: port for port, where in NODES[tag].ports.items()} if tag else {}
    found = []
    for key in keys:
        where = f"{kind}.{key}"
        port = ports.get(where, key)
        if (kind, key) == ("topic", "rate"):
            found += [Argument(name, "frequency", where, port) for name in RATES]
        else:
            found.append(Argument(_name(kind, port, keys), _type(kind, key), where, port))
    return Behavior(kind, {argument.name: argument for argument in found}, tag)


def _type(kind: str, key: str) -> str:
    return _TYPES.get((kind, key)) or _SHARED.get(key, "string")


def _name(kind: str, port: str, keys: tuple[str, ...]) -> str:
    if port in _SUBJECTS:
        return f"{port}_name"
    if port == "type":
        return f"{next((key for key in keys if key in _SUBJECTS), kind)}_type"
    return f"{kind}_{port}" if port in WORDS else port


ACTIONS: Mapping[str, Behavior] = {
    "topic": _leaf("topic", TOPIC_KEYS),
    **{kind: _leaf(kind, leaf.keys) for kind, leaf in LEAVES.items()},
}
"""The leaves, by name."""

MODIFIERS: Mapping[str, Behavior] = {
    "inverter": Behavior("inverter", {}, "Inverter"),
    "while_task_active": Behavior(
        "while",
        {
            **{
                f"action_{'name' if key == 'action' else key}": Argument(
                    f"action_{'name' if key == 'action' else key}", "string", f"while.task_active.{key}", key
                )
                for key in TASK_KEYS
            },
            "settle": Argument("settle", _SHARED["settle"], "settle", "settle"),
        },
        "WhileTaskActive",
    ),
}
"""What is written in the ``with:`` of a node, by name."""

COMPOSITIONS: Mapping[str, str] = {"serial": "sequence", "parallel": "parallel", "one_of": "selector"}
"""What the operators of the language are in the short form."""

_STATUSES = ("failure", "running", "success")
STATUS_CHANGES = tuple(f"{one}_is_{other}" for one in _STATUSES for other in _STATUSES)
"""What scenario-execution calls the modifiers by which one status counts as another."""

_ONCE = "a health tree is asked again and again anyway; leave it out, and give the leaf in it a longer gap or window"
_LATER = (
    "how long something may be missing is said by gap, window and settle, and by debounce of the policy; leave it out"
)
_CERTAIN = "a verdict that is certain, or never comes, says nothing about the robot; leave it out"
_RECOVERY = "a health tree only judges; what is done after a failure belongs into spec.strategies of the policy"
_STORE = "nothing is remembered or written while a tree is judged; leave it out"
_NO_PROCESSES = "a health tree starts no processes and reads no files; write what must hold, such as topic() or value()"
_LOOKS = "procedures and checks look once, a health tree watches; write what must hold, such as lifecycle() or node()"

_OTHERS: Mapping[str, str] = {
    **UNUSABLE,
    **dict.fromkeys(("run_process", "process_log_check"), _NO_PROCESSES),
    **dict.fromkeys(("increment", "decrement", "log"), _STORE),
    "compare": "values of messages are compared by value(); write that",
    "retry": _ONCE,
    "repeat": _ONCE,
    "timeout": _LATER,
    **dict.fromkeys(STATUS_CHANGES, _CERTAIN),
    "topic_monitor": "write topic()",
    "assert_topic_latency": "write age()",
    "wait_for_topics": "write topic(), or publisher() for one that says something seldom",
    **dict.fromkeys(("check_data", "wait_for_data"), "write value()"),
    **dict.fromkeys(
        ("action_call", "service_call", "topic_publish", "set_node_parameter", "kubernetes_delete"), _RECOVERY
    ),
    "kubernetes_patch_network_policy": _RECOVERY,
    **dict.fromkeys(procedure_vocabulary.STEPS, _RECOVERY),
    **dict.fromkeys(procedure_vocabulary.LOOKS, _LOOKS),
}

REFUSED: Mapping[str, str] = {name: why for name, why in _OTHERS.items() if name not in ACTIONS}
"""Why behaviours that users of scenario-execution know aren't for health trees, and what is."""
