"""Parameters of nodes of the active instance, from their parameter events and their answers to requests."""

from __future__ import annotations

from typing import Any, NamedTuple

from understudy.ros.observe.node_inquiries import Inquiries
from understudy.trees.core.observations import Content, ParameterState, ParameterValue
from understudy.trees.leaves.parameter import EVENTS

GET_PARAMETERS = "rcl_interfaces/srv/GetParameters"


class Setting(NamedTuple):
    """The value of a parameter."""

    value: ParameterValue | None
    lacks: str = ""
    """Why it has no value, as text."""


class ParameterValues(Inquiries[tuple[str, str], Setting, ParameterState]):
    """Some parameters, each by the fully qualified name of its node and its own name."""

    absent = Setting(None, "it is not available because there is no such node")

    def topic(self, subject: tuple[str, str]) -> str:
        """Return the topic on which all nodes report their parameters."""
        return EVENTS

    def from_message(self, subject: tuple[str, str], content: Content) -> Setting | None:
        """Return the parameter in a node's event.

        A message that does not contain the names of parameter and node is not deserialized.
        """
        node, name = subject
        if not (content.mentions(name) and content.mentions(node)):
            return None
        message: Any = content.message()
        if message.node != node:
            return None
        for parameter in (*message.changed_parameters, *message.new_parameters):
            if parameter.name == name:
                return setting(parameter.value)
        gone = any(parameter.name == name for parameter in message.deleted_parameters)
        return Setting(None, "it is not set") if gone else None

    def service(self, subject: tuple[str, str]) -> tuple[str, str]:
        """Return the service that reports the value."""
        return f"{subject[0]}/get_parameters", GET_PARAMETERS

    def request(self, subject: tuple[str, str], type_: Any) -> Any:
        """Return the request for one parameter.

        A node that lacks one of several parameters does not report the others either.
        """
        return type_.Request(names=[subject[1]])

    def from_answer(self, answer: Any) -> Setting:
        """Return the value in an answer."""
        return setting(answer.values[0]) if answer.values else Setting(None, "it is not set")

    def words(self, fact: Setting) -> str:
        """Return a parameter as text, different for each value."""
        return repr(fact.value) if fact.value is not None else fact.lacks.removeprefix("it is ")

    def blind(self, subject: tuple[str, str], nodes: int, found: str) -> str:
        """Return why the value cannot be determined."""
        node, name = subject
        return (
            f"parameter {name} of {node} cannot be determined: of {nodes} nodes of that name, in different pods, {found}, "
            "and the node of the active instance has not reported a change since the monitor started to watch it"
        )

    def evidence(self, received: float, fact: Setting | None) -> ParameterState:
        """Return the parameter as evidence."""
        if fact is None:
            return ParameterState(received, None, "", is_known=False)
        return ParameterState(received, fact.value, fact.lacks)


def setting(value: Any) -> Setting:
    """Return the contents of a rcl_interfaces/msg/ParameterValue."""
    match value.type:  # rcl_interfaces/msg/ParameterType
        case 0:
            return Setting(None, "it is not set")
        case 1:
            return Setting(bool(value.bool_value))
        case 2:
            return Setting(int(value.integer_value))
        case 3:
            return Setting(float(value.double_value))
        case 4:
            return Setting(str(value.string_value))
    return Setting(None, "it is an array")
