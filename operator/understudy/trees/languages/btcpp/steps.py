"""The nodes that a procedure or a check in XML can have, and for the other nodes of BehaviorTree.CPP 4 why it cannot
have them."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees.languages.btcpp import thresholds
from understudy.trees.languages.btcpp.library import (
    CONSTANTS,
    ENTRY_NODES,
    LOOPS,
    NODES,
    REFUSED,
    REFUSED_PLUGIN_TAGS,
    SCRIPT_NODES,
    SWITCHES,
    Category,
    Library,
    Node,
    tag_of,
)
from understudy.trees.languages.short.procedure_loader import HEALTH
from understudy.trees.languages.text import step_values
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.procedure_leaves import StepKind
from understudy.trees.source import tree_kinds
from understudy.trees.source.tree_kinds import TreeKind
from understudy.trees.source.value_reader import found_text


def _milliseconds(text: str) -> str:
    """Convert a duration in milliseconds into the short form."""
    if not (text.isascii() and text.isdigit()):
        raise ValueError(f"found {found_text(text)}; give a whole number of milliseconds, such as 5000")
    return f"{text}ms"


def _own(category: Category, key: str, step: StepKind) -> Node:
    ports = {one.port: f"{key}.{one.name}" for one in step.arguments}
    reads = {one.port: step_values.READS[one.type] for one in step.arguments if one.type in step_values.READS}
    return Node(category, key, ports, reads)


_CONTROLS: Mapping[str, Node] = {
    "Sequence": Node("Control", "sequence"),
    "AsyncSequence": Node("Control", "sequence"),
    "Fallback": Node("Control", "selector"),
    "AsyncFallback": Node("Control", "selector"),
    "Parallel": Node("Control", "parallel", {"success_count": "", "failure_count": ""}),
    "Inverter": Node("Decorator", "inverter"),
}
_DECORATORS: Mapping[str, Node] = {
    "Timeout": Node("Decorator", "timeout", {"msec": "timeout.within"}, {"msec": _milliseconds}),
    "RetryUntilSuccessful": Node(
        "Decorator",
        "retry",
        {"num_attempts": "retry.times", "wait": "retry.wait"},
        {"num_attempts": step_values.whole_of},
    ),
}
_STEPS: Mapping[str, Node] = {tag_of(key): _own("Action", key, step) for key, step in procedure_leaves.STEPS.items()}
_CHECKS_ONLY: Mapping[str, Node] = {
    tag_of(key): _own("Condition", key, step) for key, step in procedure_leaves.CONDITIONS.items()
}
_LEAVES: Mapping[str, Node] = {tag: node for tag, node in NODES.items() if node.category == "Condition"}
_WATCHED: Mapping[str, Node] = {tag: node for tag, node in _LEAVES.items() if node.key in HEALTH}

_NO_SCRIPTS = "scripts are not run; write what must hold before a node in front of it, in a <Sequence>"
_IN_ORDER = "a procedure runs each node once, in order; write"
_ONCE = "a procedure is run once; write <RetryUntilSuccessful> for what may have to be tried again"
_BRANCH = "write a <Fallback> with a <Sequence> in it: first the condition, then what depends on it"
_WAIT = "<WaitFor>, or a condition such as <Topic>, says what to wait for; remove it"
_CERTAIN = "it does nothing to the instance; remove it"
_OTHERWISE = "write what to do after a failure as the next node, in a <Fallback>"
_STORE = 'a procedure writes nothing; give constants as attributes of <SubTree>, such as node="/amcl"'
_DRIVING = "it judges the active instance only, and this one is not active yet; remove it"

_SEQUENCES = ("SequenceWithMemory", "SequenceStar", "ReactiveSequence", "PipelineSequence")
_FALLBACKS = ("FallbackStar", "ReactiveFallback", "RoundRobin", "ManualSelector")
_TRIES = ("RetryUntilSuccesful", "RecoveryNode", "RateController", "RunOnce", *LOOPS)

_REFUSED: Mapping[str, str] = {
    **REFUSED_PLUGIN_TAGS,
    **{tag: _DRIVING for tag in _LEAVES if tag not in _WATCHED},
    **dict.fromkeys(_SEQUENCES, f"{_IN_ORDER} <Sequence>"),
    **dict.fromkeys(_FALLBACKS, f"{_IN_ORDER} <Fallback>"),
    "ParallelAll": "after a failure it waits for the other nodes; write <Parallel>, which cancels them",
    **dict.fromkeys(("IfThenElse", "WhileDoElse", *SWITCHES), _BRANCH),
    **dict.fromkeys(("TryCatch", "ForceSuccess", "ForceFailure"), _OTHERWISE),
    **dict.fromkeys(_TRIES, _ONCE),
    **dict.fromkeys(("Delay", "Sleep"), _WAIT),
    **dict.fromkeys(CONSTANTS, _CERTAIN),
    **dict.fromkeys(SCRIPT_NODES, _NO_SCRIPTS),
    **dict.fromkeys(ENTRY_NODES, _STORE),
    "WhileTaskActive": "a procedure is run whatever the robot works on; write the node that is in it",
    "SubTreePlus": REFUSED["SubTreePlus"],
}


def _library(subject: TreeKind, nodes: Mapping[str, Node], refused: Mapping[str, str]) -> Library:
    return Library(subject, nodes, refused, _NO_SCRIPTS, "Sequence", thresholds.all_of)


PROCEDURES = _library(
    tree_kinds.PROCEDURE, {**_CONTROLS, **_DECORATORS, **_STEPS, **_CHECKS_ONLY, **_WATCHED}, _REFUSED
)
"""Procedures."""

CHECKS = _library(
    tree_kinds.CHECK,
    {**_CONTROLS, **_CHECKS_ONLY, **_WATCHED},
    {
        **_REFUSED,
        **dict.fromkeys(
            (*_DECORATORS, *_STEPS, "Delay", "Sleep"), "a check takes no action; it belongs in a procedure"
        ),
        **dict.fromkeys(_TRIES, "a check is evaluated in every period; remove it"),
        "WhileTaskActive": "an instance that waits has no task; write the node that is in it",
    },
)
"""Checks."""
