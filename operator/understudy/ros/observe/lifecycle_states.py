"""The states of managed nodes of the active instance, from their transition events and their answers."""

from __future__ import annotations

from typing import Any

from understudy.ros.observe.node_inquiries import Inquiries
from understudy.trees.core.observations import Content, NodeState
from understudy.trees.leaves.lifecycle import EVENTS

GET_STATE = "lifecycle_msgs/srv/GetState"


class LifecycleStates(Inquiries[str, str, NodeState]):
    """States of some managed nodes, by their names, fully qualified."""

    absent = ""

    def topic(self, subject: str) -> str:
        """Where a node reports its transitions."""
        return f"{subject}{EVENTS}"

    def told(self, subject: str, content: Content) -> str | None:
        """The state that a transition leads to."""
        message: Any = content.message()
        return str(message.goal_state.label)

    def service(self, subject: str) -> tuple[str, str]:
        """The service that says its state."""
        return f"{subject}/get_state", GET_STATE

    def request(self, subject: str, type_: Any) -> Any:
        """A request says nothing."""
        return type_.Request()

    def answered(self, answer: Any) -> str:
        """The state that a node says it is in."""
        return str(answer.current_state.label)

    def words(self, fact: str) -> str:
        """A state is a word."""
        return fact

    def blind(self, subject: str, nodes: int, found: str) -> str:
        """Why its state cannot be determined."""
        return (
            f"the state of {subject} cannot be determined: of {nodes} nodes of that name, in different pods, {found}, "
            "and the one of the active instance has reported no transition since it has been watched"
        )

    def evidence(self, received: float, fact: str | None) -> NodeState:
        """What is known of it."""
        return NodeState(received, fact)
