"""Clients and servers of actions of any installed type, with goals, feedback and results as serialized bytes.

An action is three services and two topics under ``NAME/_action`` (REP-2011's successor in design.ros2.org, "Actions").
This module uses them directly, because the task proxy keeps the client's goal id and may answer after its own restart.
rclpy's client creates a new goal id for a goal that is passed on. rclpy's server answers a goal, or a request for its
result, only within the process that received it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from understudy.ros.runtime.interface_types import interface_class

# isort: split
from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_services_default
from rclpy.serialization import deserialize_message, serialize_message
from unique_identifier_msgs.msg import UUID

from understudy.ros.runtime.served_node import ServedNode, ignore_message
from understudy.ros.runtime.service_client import ServiceClient
from understudy.ros.runtime.service_exchange import RequestId, ServiceExchangeError, request_writer

_logger = logging.getLogger(__name__)

UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(7)
"""Values of action_msgs/msg/GoalStatus."""

ENDED = frozenset({SUCCEEDED, CANCELED, ABORTED})

CANCEL_OK, CANCEL_REJECTED, CANCEL_UNKNOWN, CANCEL_ENDED = range(4)
"""Return codes of action_msgs/srv/CancelGoal: ERROR_NONE, ERROR_REJECTED, ERROR_UNKNOWN_GOAL_ID,
ERROR_GOAL_TERMINATED."""

UNANSWERED = 0.2
"""Seconds until an answer is sent again to a client that was not matched, for example after a restart of this
process."""

MATCHED = 0.5
"""Seconds after the discovery of a client until it can be answered, if it sent its request to an earlier process."""

PATIENCE = 60.0
"""Seconds for which the answer is tried."""

_RELIABLE = {"history": HistoryPolicy.KEEP_LAST, "reliability": ReliabilityPolicy.RELIABLE}
_FEEDBACK = QoSProfile(depth=10, durability=DurabilityPolicy.VOLATILE, **_RELIABLE)
_STATUS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, **_RELIABLE)
_DRAINED = QoSProfile(depth=200, durability=DurabilityPolicy.VOLATILE, **_RELIABLE)

_ID = slice(4, 20)
"""Position of the goal's id in a serialized feedback message: after the header of 4 bytes."""


@dataclass(frozen=True)
class ActionType:
    """The types of an action."""

    name: str
    goal: Any
    result: Any
    feedback: Any
    send_goal: Any
    get_result: Any

    @classmethod
    def of(cls, name: str) -> ActionType:
        """Return an action type by its name, such as nav2_msgs/action/NavigateToPose.

        Raises ValueError and TypeNotInstalled.
        """
        if "/action/" not in name:
            raise ValueError(
                f"{name!r} is not an action type: write package/action/Name, such as nav2_msgs/action/NavigateToPose"
            )
        found = interface_class(name)
        return cls(
            name=name,
            goal=found.Goal,
            result=found.Result,
            feedback=found.Impl.FeedbackMessage,
            send_goal=found.Impl.SendGoalService,
            get_result=found.Impl.GetResultService,
        )


class CancelRequest(NamedTuple):
    """What a client requests to cancel: a goal, those up to a time, or both.

    Neither means all goals (see CancelGoal).
    """

    goal: str
    """The goal's id in hex; empty if none is named."""
    until: int
    """Unix nanoseconds; 0 if no time is given."""


class KnownGoal(NamedTuple):
    """A goal in a server's status."""

    goal: str
    accepted: int
    """When it was accepted, in Unix nanoseconds."""
    status: int


def renamed(feedback: bytes, goal: str) -> bytes:
    """Return a feedback message with the id of another goal."""
    return feedback[: _ID.start] + bytes.fromhex(goal) + feedback[_ID.stop :]


def _uuid(goal: str) -> UUID:
    return UUID(uuid=list(bytes.fromhex(goal)))


def _hex(uuid: UUID) -> str:
    return bytes(uuid.uuid).hex()


def _time(nanoseconds: int) -> Time:
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def _nanoseconds(moment: Time) -> int:
    return int(moment.sec) * 1_000_000_000 + int(moment.nanosec)


@dataclass(frozen=True)
class RequestHandlers:
    """Callbacks of a server for its clients' requests, called in the event loop."""

    goal: Callable[[RequestId, str, bytes], None]
    """A client asks to accept a goal: its id and the serialized goal."""
    cancel: Callable[[RequestId, CancelRequest], None]
    result: Callable[[RequestId, str], None]


class ActionServer:
    """Serves an action. The answers may be given at any later time."""

    def __init__(self, served: ServedNode, action: str, type_: ActionType, asked: RequestHandlers) -> None:
        self.action, self.type = action, type_
        self._served, self._asked = served, asked
        self._services: dict[str, Any] = {}
        self._clients: set[str] = set()
        self._publishers: dict[str, Any] = {}

    async def open(self) -> None:
        """Create the server's endpoints."""
        await self._served.get(self._open)

    async def close(self) -> None:
        """Remove the server's endpoints."""
        await self._served.get(self._close)

    def answer_goal(self, request: RequestId, accepted: bool, stamp: int) -> None:
        """Accept or reject a goal; ``stamp`` is the time of acceptance in Unix nanoseconds."""
        self._answer("send_goal", self.type.send_goal.Response(accepted=accepted, stamp=_time(stamp)), request)

    def answer_cancel(self, request: RequestId, code: int, goals: Sequence[tuple[str, int]]) -> None:
        """Answer which goals, with the times of their acceptance, are being cancelled."""
        infos = [GoalInfo(goal_id=_uuid(goal), stamp=_time(stamp)) for goal, stamp in goals]
        self._answer("cancel_goal", CancelGoal.Response(return_code=code, goals_canceling=infos), request)

    def answer_result(self, request: RequestId, status: int, result: bytes) -> None:
        """Answer with a goal's serialized result; empty for an unknown goal."""
        message = deserialize_message(result, self.type.result) if result else self.type.result()
        self._answer("get_result", self.type.get_result.Response(status=status, result=message), request)

    def publish_feedback(self, feedback: bytes) -> None:
        """Pass on a serialized feedback message."""
        self._served.do(lambda: self._publishers["feedback"].publish(feedback))

    def publish_status(self, goals: Sequence[KnownGoal]) -> None:
        """Publish the status of all goals."""
        statuses = [
            GoalStatus(goal_info=GoalInfo(goal_id=_uuid(g.goal), stamp=_time(g.accepted)), status=g.status)
            for g in goals
        ]
        message = GoalStatusArray(status_list=statuses)
        self._served.do(lambda: self._publishers["status"].publish(message))

    def _open(self) -> None:
        node, hidden = self._served.node, f"{self.action}/_action"
        # The topics first: a client considers the server present as soon as it sees all five.
        for name, type_, qos in (("feedback", self.type.feedback, _FEEDBACK), ("status", GoalStatusArray, _STATUS)):
            self._publishers[name] = node.create_publisher(type_, f"{hidden}/{name}", qos)
        for name, type_, taken in (
            ("send_goal", self.type.send_goal, self._goal_asked),
            ("cancel_goal", CancelGoal, self._cancel_asked),
            ("get_result", self.type.get_result, self._result_asked),
        ):
            service = node.create_service(
                type_, f"{hidden}/{name}", _never_called, qos_profile=qos_profile_services_default
            )
            self._services[name] = service
            self._served.add("service", service, self._taking(service, type_.Request, taken))

    def _close(self) -> None:
        for service in self._services.values():
            self._served.remove("service", service)
        for publisher in self._publishers.values():
            self._served.node.destroy_publisher(publisher)

    def _goal_asked(self, request: Any, identity: RequestId) -> None:
        data = serialize_message(request.goal)
        self._served.call_in_loop(self._asked.goal, identity, _hex(request.goal_id), data)

    def _cancel_asked(self, request: Any, identity: RequestId) -> None:
        goal, until = _hex(request.goal_info.goal_id), _nanoseconds(request.goal_info.stamp)
        self._served.call_in_loop(self._asked.cancel, identity, CancelRequest("" if goal == _NONE else goal, until))

    def _result_asked(self, request: Any, identity: RequestId) -> None:
        self._served.call_in_loop(self._asked.result, identity, _hex(request.goal_id))

    def _taking(self, service: Any, request: Any, taken: Callable[[Any, RequestId], None]) -> Callable[[], None]:
        def take() -> None:
            while (found := self._served.exchange.take(service, request)) is not None:
                self._clients.add(found[1].client)
                taken(*found)

        return take

    def _answer(self, name: str, response: Any, request: RequestId) -> None:
        end = time.monotonic() + PATIENCE
        found: float | None = None

        def send() -> None:
            nonlocal found
            known = request.client in self._clients
            identity = request if known else self._written_by(name, request)
            now = time.monotonic()
            if identity is not None and found is None:
                found = now
            if known or (found is not None and now - found >= MATCHED and identity is not None):
                try:
                    if self._served.exchange.answer(self._services[name], response, identity or request):
                        return
                except ServiceExchangeError as error:
                    _logger.error("%s: %s", self.action, error)
                    return
            if now < end:
                self._served.after(UNANSWERED, send)

        self._served.do(send)

    def _written_by(self, name: str, request: RequestId) -> RequestId | None:
        """Return the identity with which a request to an earlier process can be answered.

        None while the client of the request is not discovered.
        """
        topic = f"{self.action}/_action/{name}"
        node = self._served.node
        readers = node.get_subscriptions_info_by_topic(f"rr{topic}Reply", no_mangle=True)
        if not any(bytes(info.endpoint_gid)[:16].hex() == request.client for info in readers):
            return None
        infos = node.get_publishers_info_by_topic(f"rq{topic}Request", no_mangle=True)
        writer = request_writer(request, [bytes(info.endpoint_gid)[:16] for info in infos])
        return RequestId(writer.hex(), request.sequence) if writer else None


_NONE = bytes(16).hex()


def _never_called(request: object, response: Any) -> Any:
    """Satisfy rclpy, which requires a callback."""
    return response


class ActionClient:
    """Uses an action. Its methods wait for as long as the server takes: callers set a bound."""

    def __init__(
        self,
        served: ServedNode,
        action: str,
        type_: ActionType,
        *,
        on_feedback: Callable[[str, bytes], None],
    ) -> None:
        """``on_feedback`` receives a goal's id and the whole serialized message, in the event loop."""
        self.action, self.type = action, type_
        self._served, self._on_feedback = served, on_feedback
        self._clients: dict[str, ServiceClient] = {}

    async def open(self) -> None:
        """Create the client's endpoints."""
        await self._served.get(self._open)

    async def ready(self) -> bool:
        """Return whether a server with all endpoints of the action is present."""
        return await self._served.get(self._ready)

    async def send_goal(self, goal: str, data: bytes) -> tuple[bool, int]:
        """Send a serialized goal under an id. Returns whether it was accepted, and when (Unix nanoseconds)."""
        message = deserialize_message(data, self.type.goal)
        request = self.type.send_goal.Request(goal_id=_uuid(goal), goal=message)
        response = await self._clients["send_goal"].call(request)
        return bool(response.accepted), _nanoseconds(response.stamp)

    async def cancel(self, goal: str) -> int:
        """Request to cancel a goal. Returns the server's return code."""
        request = CancelGoal.Request(goal_info=GoalInfo(goal_id=_uuid(goal)))
        return int((await self._clients["cancel_goal"].call(request)).return_code)

    async def result(self, goal: str) -> tuple[int, bytes]:
        """Wait for the end of a goal.

        Returns its status and serialized result; UNKNOWN at once if the server does not know the goal.
        """
        response = await self._clients["get_result"].call(self.type.get_result.Request(goal_id=_uuid(goal)))
        return int(response.status), serialize_message(response.result)

    def _open(self) -> None:
        node, hidden = self._served.node, f"{self.action}/_action"
        for name, type_ in (
            ("send_goal", self.type.send_goal),
            ("cancel_goal", CancelGoal),
            ("get_result", self.type.get_result),
        ):
            self._clients[name] = ServiceClient(self._served, type_, f"{hidden}/{name}")
        subscription = node.create_subscription(
            self.type.feedback, f"{hidden}/feedback", ignore_message, _DRAINED, raw=True
        )
        self._served.add("subscription", subscription, self._received(subscription))

    def _ready(self) -> bool:
        if not all(client.ready() for client in self._clients.values()):
            return False
        return all(
            self._served.node.count_publishers(f"{self.action}/_action/{name}") for name in ("feedback", "status")
        )

    def _received(self, subscription: Any) -> Callable[[], None]:
        def take() -> None:
            with subscription.handle:
                while (sample := self._served.taker.take(subscription.handle.pointer)) is not None:
                    self._served.call_in_loop(self._on_feedback, sample.data[_ID].hex(), sample.data)

        return take
