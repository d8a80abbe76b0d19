"""Declares to the three languages the leaves that only procedures and checks have.

`trees.languages.short.procedure_loader` implements them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from understudy.trees.leaves.leaf_plan import Key, time_key
from understudy.trees.leaves.lifecycle import STATES


@dataclass(frozen=True)
class StepKind:
    """A leaf of procedures or checks."""

    summary: str
    """What it does, such as ``sets `values` of a `node```."""
    arguments: tuple[Key, ...] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys in the short form."""
        return tuple(key.name for key in self.arguments)


_MANAGED_NODE = Key("node", "the managed node, fully qualified, such as /amcl")
_NODE = Key("node", "the node, fully qualified, such as /amcl")
_STATE = Key("state", "unconfigured, inactive, active or finalized", "lifecycle_state", STATES)

STEPS: Mapping[str, StepKind] = {
    "set_lifecycle": StepKind("brings a managed node to a state", (_MANAGED_NODE, _STATE)),
    "call_service": StepKind(
        "calls a service of a type with a request",
        (
            Key("service", "the service, fully qualified, such as /map_server/load_map"),
            Key("type", "package/srv/Name"),
            Key("request", "fields of the request; the others keep their defaults", "structure"),
            Key("expect", "fields that the answer must have", "structure"),
            time_key("repeat", "the time without an answer after which it is called again, such as 5s"),
        ),
    ),
    "publish": StepKind(
        "publishes a message of a type on a topic, once there is a subscriber",
        (
            Key("topic", "the topic, fully qualified, such as /initialpose"),
            Key("type", "package/msg/Name"),
            Key("message", "fields of the message; the others keep their defaults", "structure"),
        ),
    ),
    "set_parameters": StepKind(
        "sets values of a node", (_NODE, Key("values", "the parameters with their values", "structure"))
    ),
    "wait_for": StepKind(
        "waits for a service, a node, or a message of a topic and type, for at most the time of within",
        (
            Key("topic", "the topic of which a message must arrive, such as /scan"),
            Key("type", "package/msg/Name of the topic"),
            Key("service", "instead, the service that must be there"),
            Key("node", "instead, the node that must be there"),
            time_key("within", "how long it may take, such as 20s"),
        ),
    ),
    "restore_state": StepKind(
        "gives the kept state here",
        (Key("only", "the kept topics and nodes, such as /amcl_pose; all if none is given", "names", osc="names"),),
    ),
    "resend_goals": StepKind("asks the action proxy to send the unfinished goals to the instance now"),
}
"""The steps of procedures, by their keys in the short form."""

CONDITIONS: Mapping[str, StepKind] = {
    "lifecycle_is": StepKind("a managed node is in a state", (_MANAGED_NODE, _STATE)),
    "node_present": StepKind("the node is there", (_NODE,)),
    "service_present": StepKind(
        "the service is there", (Key("service", "the service, fully qualified, such as /map_server/load_map"),)
    ),
    "parameter_is": StepKind(
        "a parameter of a node, by its name, has a value",
        (
            _NODE,
            Key("name", "the parameter's name", xml="parameter"),
            Key("value", "the value that it must have", "structure"),
        ),
    ),
}
"""Conditions that are checked once, unlike the leaves of health trees, which are watched."""
