"""The nodes that a health tree in XML can have, and why it can't have the others of BehaviorTree.CPP 4."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from understudy.trees.languages.btcpp import thresholds
from understudy.trees.leaves import procedure_vocabulary
from understudy.trees.leaves.action_progress import PROGRESS
from understudy.trees.leaves.age import AGE
from understudy.trees.leaves.diagnostics import DIAGNOSTICS
from understudy.trees.leaves.lifecycle import LIFECYCLE
from understudy.trees.leaves.log import LOG
from understudy.trees.leaves.motion import MOTION
from understudy.trees.leaves.node import NODE
from understudy.trees.leaves.parameter import PARAMETER
from understudy.trees.leaves.pod import POD_LEAF
from understudy.trees.leaves.publisher import PUBLISHER
from understudy.trees.leaves.registry import ADDED, UNUSABLE
from understudy.trees.leaves.transform import TRANSFORM
from understudy.trees.leaves.value import VALUE
from understudy.trees.source import tree_kinds
from understudy.trees.source.tree_kinds import Subject

Category = Literal["Action", "Condition", "Control", "Decorator"]


@dataclass(frozen=True)
class Node:
    """A node that can be written."""

    category: Category
    key: str
    """What it is in the short form; a Parallel says by its thresholds which."""
    ports: Mapping[str, str] = field(default_factory=dict)
    """Where the value of each of its ports goes in the short form, as a path from the node; empty where it goes nowhere."""
    reads: Mapping[str, Callable[[str], Any]] = field(default_factory=dict)
    """What reads the values of ports that are no texts in the short form. Raises ValueError."""

    @property
    def a(self) -> str:
        """Its category with an article."""
        return f"an {self.category}" if self.category == "Action" else f"a {self.category}"


def tag_of(key: str) -> str:
    """What a leaf of procedures, or of another package, is called in XML, such as ``SetLifecycle`` for ``set_lifecycle``."""
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
    "Topic": Node(
        "Condition",
        "topic",
        # `name` is the node's own name in BehaviorTree.CPP, so the topic's can't be.
        {
            "topic": "topic.name",
            "type": "topic.type",
            "gap": "topic.gap",
            "rate": "topic.rate",
            "window": "topic.window",
        },
    ),
    "Value": Node("Condition", "value", {key: f"value.{key}" for key in VALUE.keys}),
    "Age": Node("Condition", "age", {key: f"age.{key}" for key in AGE.keys}),
    "Diagnostics": Node(
        "Condition",
        "diagnostics",
        {"status" if key == "name" else key: f"diagnostics.{key}" for key in DIAGNOSTICS.keys},
    ),
    "Transform": Node("Condition", "transform", {key: f"transform.{key}" for key in TRANSFORM.keys}),
    "Publisher": Node("Condition", "publisher", {key: f"publisher.{key}" for key in PUBLISHER.keys}),
    "Node": Node("Condition", "node", {"node" if key == "name" else key: f"node.{key}" for key in NODE.keys}),
    "Log": Node("Condition", "log", {key: f"log.{key}" for key in LOG.keys}),
    "Progress": Node("Condition", "progress", {key: f"progress.{key}" for key in PROGRESS.keys}),
    "Lifecycle": Node("Condition", "lifecycle", {key: f"lifecycle.{key}" for key in LIFECYCLE.keys}),
    "Motion": Node("Condition", "motion", {key: f"motion.{key}" for key in MOTION.keys}),
    "Parameter": Node(
        "Condition",
        "parameter",
        {"parameter" if key == "name" else key: f"parameter.{key}" for key in PARAMETER.keys},
    ),
    "Pod": Node("Condition", "pod", {key: f"pod.{key}" for key in POD_LEAF.keys}),
    **{
        tag_of(kind): Node("Condition", kind, {key: f"{kind}.{key}" for key in leaf.keys})
        for kind, leaf in ADDED.items()
    },
}

EXPLICIT = ("Action", "Condition", "Control", "Decorator")
"""Tags of the explicit notation, ``<Condition ID="Topic"/>`` for ``<Topic/>``."""

IGNORED = frozenset({"_description", "_collapsed", "_fullpath", "_uid"})
"""What Groot 2, and BehaviorTree.CPP when it writes a running tree, add to nodes for themselves."""

SCRIPTS = frozenset({"_skipIf", "_successIf", "_failureIf", "_while", "_onSuccess", "_onFailure", "_onHalted", "_post"})
"""Pre- and postconditions, which are scripts."""

NO_SCRIPTS = (
    "scripts aren't run; what only counts while the robot works on a task goes into "
    '<WhileTaskActive action="/navigate_to_pose">'
)

_ANEW = "a health tree is asked anew at every look and remembers nothing; write"
_ONCE = "a health tree is asked again and again anyway; leave it out, and give the leaf in it a longer gap or window"
_LATER = (
    "how long something may be missing is said by gap, window and settle, and by debounce of the policy; leave it out"
)
_TASK = 'what decides can only be a task; write <WhileTaskActive action="/navigate_to_pose">'
_STORE = 'nothing is written while a tree is judged; give constants as attributes of <SubTree>, such as scan="/scan"'
_CERTAIN = "a verdict that is certain says nothing about the robot; leave it out"
_RECOVERY = "a health tree only judges; what is done after a failure belongs into spec.strategies of the policy"
_LOOKS = "procedures and checks look once, a health tree watches; write what must hold, such as <Lifecycle> or <Node>"

OF_OTHERS: Mapping[str, str] = {tag_of(name): why for name, why in UNUSABLE.items()}
"""Why leaves of other packages can't be used."""

REFUSED: Mapping[str, str] = {
    **OF_OTHERS,
    "SequenceWithMemory": f"{_ANEW} <Sequence>",
    "SequenceStar": f"{_ANEW} <Sequence>",
    "AsyncSequence": f"{_ANEW} <Sequence>",
    "FallbackStar": f"{_ANEW} <Fallback>",
    "AsyncFallback": f"{_ANEW} <Fallback>",
    "IfThenElse": _TASK,
    "WhileDoElse": _TASK,
    **{f"Switch{cases}": _TASK for cases in range(2, 7)},
    "ManualSelector": "nobody is there to choose; write <Fallback>",
    "TryCatch": _RECOVERY,
    "RetryUntilSuccessful": _ONCE,
    "RetryUntilSuccesful": _ONCE,
    "KeepRunningUntilFailure": _ONCE,
    "Repeat": _ONCE,
    "RunOnce": f"{_ANEW} what is in it alone",
    "LoopInt": _ONCE,
    "LoopDouble": _ONCE,
    "LoopString": _ONCE,
    "LoopBool": _ONCE,
    "Delay": _LATER,
    "Timeout": _LATER,
    "Sleep": _LATER,
    "ForceSuccess": _CERTAIN,
    "ForceFailure": _CERTAIN,
    "AlwaysSuccess": _CERTAIN,
    "AlwaysFailure": _CERTAIN,
    "TestNode": _CERTAIN,
    "Script": NO_SCRIPTS,
    "ScriptCondition": NO_SCRIPTS,
    "Precondition": NO_SCRIPTS,
    "SetBlackboard": _STORE,
    "UnsetBlackboard": _STORE,
    "SkipUnlessUpdated": _STORE,
    "WaitValueUpdate": _STORE,
    "WasEntryUpdated": _STORE,
    "SubTreePlus": 'it is of version 3; write <SubTree ID="..." _autoremap="true"/>',
    "RecoveryNode": _RECOVERY,
    "PipelineSequence": f"{_ANEW} <Sequence>",
    "RoundRobin": f"{_ANEW} <Fallback>",
    "RateController": _ONCE,
}
"""Why other nodes of BehaviorTree.CPP (and the control nodes that Nav2 adds) are not for health trees, and what is."""


@dataclass(frozen=True)
class Library:
    """What trees of one kind can have."""

    subject: Subject
    nodes: Mapping[str, Node]
    refused: Mapping[str, str]
    """Why they can't have other nodes, and what is right."""
    no_scripts: str
    """What is said of scripts."""
    group: str
    """The node that most often has others in it."""
    parallel: Callable[[str, Mapping[str, str], int], str]
    """What a <Parallel> is in the short form: its tag, its thresholds and how many nodes it has. Raises ValueError."""


HEALTH = Library(
    tree_kinds.HEALTH,
    NODES,
    {
        **REFUSED,
        **{tag_of(key): _RECOVERY for key in procedure_vocabulary.STEPS},
        **{tag_of(key): _LOOKS for key in procedure_vocabulary.LOOKS},
    },
    NO_SCRIPTS,
    "Parallel",
    thresholds.key_of,
)
"""Health trees."""
