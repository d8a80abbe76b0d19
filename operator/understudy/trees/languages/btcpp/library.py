"""The nodes that a health tree in XML can have, and for the other nodes of BehaviorTree.CPP 4 why it cannot have
them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from understudy.trees.languages.btcpp import thresholds
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import LEAVES, REFUSED_PLUGINS
from understudy.trees.source import tree_kinds
from understudy.trees.source.tree_kinds import TreeKind

Category = Literal["Action", "Condition", "Control", "Decorator"]


@dataclass(frozen=True)
class Node:
    """A supported node."""

    category: Category
    key: str
    """Its key in the short form; a Parallel's key depends on its thresholds."""
    ports: Mapping[str, str] = field(default_factory=dict)
    """By port, the path from the node to the port's value in the short form; empty if the value is dropped."""
    reads: Mapping[str, Callable[[str], Any]] = field(default_factory=dict)
    """By port, the parser of values that are not texts in the short form. Raises ValueError."""

    @property
    def a(self) -> str:
        """Its category with an article."""
        return f"an {self.category}" if self.category == "Action" else f"a {self.category}"


def tag_of(key: str) -> str:
    """Return the name of a leaf or step in XML, such as ``SetLifecycle`` for ``set_lifecycle``."""
    return "".join(part.capitalize() for part in key.split("_"))


NODES: Mapping[str, Node] = {
    "Sequence": Node("Control", "sequence"),
    "ReactiveSequence": Node("Control", "sequence"),
    "Fallback": Node("Control", "selector"),
    "ReactiveFallback": Node("Control", "selector"),
    "Parallel": Node("Control", "parallel", {"success_count": "", "failure_count": ""}),
    "ParallelAll": Node("Control", "parallel", {"max_failures": ""}),
    "Inverter": Node("Decorator", "inverter"),
    "WhileTaskActive": Node(
        "Decorator",
        "while",
        {"action": "while.task_active.action", "type": "while.task_active.type", "settle": "settle"},
    ),
    **{
        tag_of(kind): Node("Condition", kind, {key.port: f"{kind}.{key.name}" for key in leaf.arguments})
        for kind, leaf in LEAVES.items()
    },
}

EXPLICIT = ("Action", "Condition", "Control", "Decorator")
"""Tags of the explicit notation, ``<Condition ID="Topic"/>`` for ``<Topic/>``."""

IGNORED = frozenset({"_description", "_collapsed", "_fullpath", "_uid"})
"""Attributes for their own use that Groot 2 adds to nodes, and BehaviorTree.CPP when it writes a running tree."""

SCRIPTS = frozenset({"_skipIf", "_successIf", "_failureIf", "_while", "_onSuccess", "_onFailure", "_onHalted", "_post"})
"""Pre- and postconditions, which are scripts."""

NO_SCRIPTS = (
    "scripts are not run; a condition that counts only during a task goes into "
    '<WhileTaskActive action="/navigate_to_pose">'
)

_ANEW = "a health tree is evaluated again at each tick and remembers nothing; write"
_ONCE = "a health tree is evaluated continuously; remove it, and give the leaf in it a longer gap or window"
_LATER = "gap, window, settle and the policy's debounce set how long something may be missing; remove it"
_TASK = 'a health tree can depend only on whether a task is active; write <WhileTaskActive action="/navigate_to_pose">'
_STORE = 'a health tree writes nothing; give constants as attributes of <SubTree>, such as scan="/scan"'
_CERTAIN = "a constant result says nothing about the robot; remove it"
_RECOVERY = "a health tree takes no action; actions after a failure belong in spec.strategies of the policy"
_CHECKS_ONLY = (
    "only procedures and checks test this once; in a health tree, write what must hold, such as <Lifecycle> or <Node>"
)

REFUSED_PLUGIN_TAGS: Mapping[str, str] = {tag_of(name): why for name, why in REFUSED_PLUGINS.items()}
"""Why leaves of other packages cannot be used, by tag."""

SWITCHES = tuple(f"Switch{cases}" for cases in range(2, 7))
LOOPS = ("KeepRunningUntilFailure", "Repeat", "LoopInt", "LoopDouble", "LoopString", "LoopBool")
SCRIPT_NODES = ("Script", "ScriptCondition", "Precondition")
ENTRY_NODES = ("SetBlackboard", "UnsetBlackboard", "SkipUnlessUpdated", "WaitValueUpdate", "WasEntryUpdated")
CONSTANTS = ("AlwaysSuccess", "AlwaysFailure", "TestNode")

REFUSED: Mapping[str, str] = {
    **REFUSED_PLUGIN_TAGS,
    **dict.fromkeys(("SequenceWithMemory", "SequenceStar", "AsyncSequence", "PipelineSequence"), f"{_ANEW} <Sequence>"),
    **dict.fromkeys(("FallbackStar", "AsyncFallback", "RoundRobin"), f"{_ANEW} <Fallback>"),
    "RunOnce": f"{_ANEW} the node in it without <RunOnce>",
    **dict.fromkeys(("IfThenElse", "WhileDoElse", *SWITCHES), _TASK),
    "ManualSelector": "nobody is present to select a node; write <Fallback>",
    **dict.fromkeys(("TryCatch", "RecoveryNode"), _RECOVERY),
    **dict.fromkeys(("RetryUntilSuccessful", "RetryUntilSuccesful", "RateController", *LOOPS), _ONCE),
    **dict.fromkeys(("Delay", "Timeout", "Sleep"), _LATER),
    **dict.fromkeys(("ForceSuccess", "ForceFailure", *CONSTANTS), _CERTAIN),
    **dict.fromkeys(SCRIPT_NODES, NO_SCRIPTS),
    **dict.fromkeys(ENTRY_NODES, _STORE),
    "SubTreePlus": 'it is of version 3; write <SubTree ID="..." _autoremap="true"/>',
}
"""Why health trees cannot have other nodes of BehaviorTree.CPP (and the control nodes that Nav2 adds), and what to use
instead."""


@dataclass(frozen=True)
class Library:
    """The nodes that trees of one kind can have."""

    subject: TreeKind
    nodes: Mapping[str, Node]
    refused: Mapping[str, str]
    """Why they cannot have other nodes, and what to use instead."""
    no_scripts: str
    """The message about scripts."""
    group: str
    """The node that most often has children."""
    parallel: Callable[[str, Mapping[str, str], int], str]
    """Returns the key of a <Parallel> in the short form, from its tag, its thresholds and its number of children.
    Raises ValueError."""


HEALTH = Library(
    tree_kinds.HEALTH,
    NODES,
    {
        **REFUSED,
        **{tag_of(key): _RECOVERY for key in procedure_leaves.STEPS},
        **{tag_of(key): _CHECKS_ONLY for key in procedure_leaves.CONDITIONS},
    },
    NO_SCRIPTS,
    "Parallel",
    thresholds.key_of,
)
"""Health trees."""
