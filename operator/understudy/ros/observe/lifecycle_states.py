"""The states of managed nodes of the active instance, from their transition events and their answers to requests."""

from __future__ import annotations

from typing import Any

from understudy.ros.observe.node_inquiries import Inquiries
from understudy.trees.core.observations import Content, NodeState
from understudy.trees.leaves.lifecycle import EVENTS

GET_STATE = "lifecycle_msgs/srv/GetState"


class LifecycleStates(Inquiries[str, str, NodeState]):
    """States of some managed nodes, by their fully qualified names."""

    absent = ""

    def topic(self, subject: str) -> str:
        """Return the topic on which a node reports its transitions."""
        return f"{subject}{EVENTS}"

    def from_message(self, subject: str, content: Content) -> str | None:
        """Return the state after a transition."""
        message: Any = content.message()
        return str(message.goal_state.label)

    def service(self, subject: str) -> tuple[str, str]:
        """Return the service that reports the state."""
        return f"{subject}/get_state", GET_STATE

    def request(self, subject: str, type_: Any) -> Any:
        """Return an empty request."""
        return type_.Request()

    def from_answer(self, answer: Any) -> str:
        """Return the state in an answer."""
        return str(answer.current_state.label)

    def words(self, fact: str) -> str:
        """Return the state itself, which is a word."""
        return fact

    def blind(self, subject: str, nodes: int, found: str) -> str:
        """Return why the state cannot be determined."""
        return (
            f"the state of {subject} cannot be determined: of {nodes} nodes of that name, in different pods, {found}, "
            "and the node of the active instance has not reported a transition since the monitor started to watch it"
        )

    def evidence(self, received: float, fact: str | None) -> NodeState:
        """Return the state as evidence."""
        return NodeState(received, fact)
