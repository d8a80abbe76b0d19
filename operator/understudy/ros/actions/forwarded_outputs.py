"""What a mux forwards for each output of a workload: a topic, a service, or the three services and two topics of an action."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Protocol

from action_msgs.srv import CancelGoal

from understudy.api.kinds.robot_workload import Output
from understudy.ros.actions.action_endpoints import ActionType
from understudy.ros.actions.forwarded_service import ForwardedService
from understudy.ros.actions.forwarded_topic import ForwardedTopic
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.ros.runtime.interface_types import interface_class
from understudy.ros.runtime.sample_taking import SampleTaker
from understudy.ros.runtime.service_exchange import ServiceExchange


class Route(Protocol):
    """One topic or service between the instances and the robot."""

    @property
    def output(self) -> str:
        """The name of the output that it belongs to."""

    def counts(self) -> tuple[int, int]:
        """Return the numbers of its writers and readers, for a hundredth of the cost of listing them."""

    def writers(self) -> list[Endpoint]:
        """Return the writers whose samples command the robot, besides this process's own."""

    def follow(self, instances: Collection[bytes]) -> None:
        """Match the endpoints of both sides as discovery reports them. ``instances`` are the writers of instances, by their GIDs."""

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Take what has arrived, and forward what a function accepts by the GID of its writer.

        The function returns None for a writer that it does not know yet. Returns the number of forwarded commands.
        """

    def forget(self) -> None:
        """Drop what is held: another instance is in control from now on."""

    def command(self, values: Mapping[str, Any]) -> None:
        """Send a safe command, given by the values of its fields: to a topic only. Raises MessageError."""


class ReturnedTopic:
    """A topic that the robot publishes to all instances, such as the feedback of an action."""

    def __init__(
        self, graph: Graph, topic: str, type_name: str, output: str, taker: SampleTaker, wakeups: ArrivalWakeups
    ) -> None:
        """As for :class:`ForwardedTopic`."""
        self.output = output
        self._topic = ForwardedTopic(graph, topic, type_name, taker, wakeups)

    def counts(self) -> tuple[int, int]:
        """Return the numbers of its writers and readers."""
        return self._topic.counts()

    def writers(self) -> list[Endpoint]:
        """Return nobody: what the robot publishes is no command."""
        return []

    def follow(self, instances: Collection[bytes]) -> None:
        """Match the QoS of the robot's writers and of the instances' readers."""
        self._topic.follow([end.gid for end in self._topic.writers()])

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Pass on everything that has arrived."""
        self._topic.drain(lambda gid: True)
        return 0

    def forget(self) -> None:
        """Nothing is held."""

    def command(self, values: Mapping[str, Any]) -> None:
        """Nothing: this is no output."""


def routes(outputs: Iterable[Output], graph: Graph, wakeups: ArrivalWakeups) -> list[Route]:
    """Return the routes of all outputs. Raises ValueError, TypeNotInstalled and NotReceivable."""
    taker, exchange = SampleTaker(), ServiceExchange()
    found: list[Route] = []
    for output in outputs:
        if output.topic:
            found.append(ForwardedTopic(graph, output.topic, output.type, taker, wakeups))
        elif output.service:
            type_ = interface_class(output.type)
            found.append(ForwardedService(graph, output.service, type_, output.name, exchange, wakeups))
        else:
            action, hidden = ActionType.of(output.type), f"{output.action}/_action"
            for name, type_ in (
                ("send_goal", action.send_goal),
                ("cancel_goal", CancelGoal),
                ("get_result", action.get_result),
            ):
                found.append(ForwardedService(graph, f"{hidden}/{name}", type_, output.name, exchange, wakeups))
            for name, type_name in (
                ("feedback", f"{output.type}_FeedbackMessage"),
                ("status", "action_msgs/msg/GoalStatusArray"),
            ):
                found.append(ReturnedTopic(graph, f"{hidden}/{name}", type_name, output.name, taker, wakeups))
    return found
