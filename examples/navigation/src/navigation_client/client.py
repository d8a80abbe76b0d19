"""Sends goals over a NavigateToPose action, one after the other, and writes down the result of each.

An ordinary action client. It asks once for each goal; only where the server says no to a goal, as a navigator does that
is not active yet, it asks again a second later. What happens behind the action's name is none of its business.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from navigation_robot.journal import Journal
from navigation_world import Pose
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.node import Node
from rclpy.task import Future

_STATUSES = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "canceled",
}

ASK_AGAIN = 1.0
"""Seconds after which a goal that was rejected is sent again."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How long the client waits, in seconds."""

    server: float = 120.0
    """For the action server to be there."""
    acceptance: float = 120.0
    """For a goal to be accepted."""
    result: float = 300.0
    """For a goal's result, from its acceptance."""


@dataclass
class _Feedback:
    """What was received of the feedback on one goal."""

    count: int = 0
    last: float = field(default_factory=time.monotonic)
    longest: float = 0.0
    remaining: float = math.nan

    def take(self, message: Any) -> None:
        now = time.monotonic()
        self.longest = max(self.longest, now - self.last)
        self.last = now
        self.count += 1
        self.remaining = float(message.feedback.distance_remaining)


class Client:
    """Works through a list of goals."""

    NAME, ACTION, TYPE = "navigation_client", "/navigate_to_pose", NavigateToPose

    def __init__(self, journal: Journal, patience: Patience | None = None) -> None:
        self._journal = journal
        self._patience = patience or Patience()
        self._node = Node(self.NAME, start_parameter_services=False)
        self._action = ActionClient(self._node, self.TYPE, self.ACTION)

    def run(self, goals: Sequence[Any], pause: float = 0.5) -> bool:
        """Send all goals, with a pause in seconds between them; whether all succeeded."""
        begun, wanted = time.time(), len(goals)
        self._journal.write("client", time=begun, goals=wanted)
        if not self._action.wait_for_server(self._patience.server):
            self._journal.write("no-server", time=time.time(), waited=self._patience.server)
            goals = []
        outcomes: list[str] = []
        for number, goal in enumerate(goals, 1):
            outcomes.append(self._go(number, goal))
            if number < len(goals):
                self._spin(pause)
        counted = {status: outcomes.count(status) for status in dict.fromkeys(("succeeded", *sorted(outcomes)))}
        self._journal.write(
            "summary", time=time.time(), goals=wanted, sent=len(outcomes), seconds=time.time() - begun, **counted
        )
        return outcomes == ["succeeded"] * wanted

    def close(self) -> None:
        """Leave the graph."""
        self._action.destroy()
        self._node.destroy_node()

    def described(self, goal: Pose) -> dict[str, float]:
        """What is written down of a goal."""
        return {"x": goal.x, "y": goal.y, "heading": goal.heading}

    def message(self, goal: Pose) -> Any:
        """A goal as it is sent."""
        message = NavigateToPose.Goal()
        message.pose.header.frame_id = "map"
        message.pose.header.stamp = self._node.get_clock().now().to_msg()
        message.pose.pose.position.x = goal.x
        message.pose.pose.position.y = goal.y
        message.pose.pose.orientation.z = math.sin(goal.heading / 2)
        message.pose.pose.orientation.w = math.cos(goal.heading / 2)
        return message

    def _go(self, number: int, goal: Any) -> str:
        self._journal.write("goal", number=number, time=time.time(), **self.described(goal))
        feedback = _Feedback()
        handle = self._accepted(number, goal, feedback)
        if handle is None:
            self._journal.write("result", number=number, time=time.time(), status="rejected", feedback=0)
            return "rejected"
        accepted = time.monotonic()
        answer = handle.get_result_async()
        if not self._wait(answer, self._patience.result):
            # Not left running behind the back of whoever reads this log.
            self._wait(handle.cancel_goal_async(), 10.0)
            self._wait(answer, 10.0)
            status, code, text = "late", -1, ""
        else:
            response = answer.result()
            status = _STATUSES.get(response.status, f"status {response.status}")
            code, text = response.result.error_code, response.result.error_msg
        self._journal.write(
            "result",
            number=number,
            time=time.time(),
            status=status,
            error_code=code,
            error_msg=text,
            seconds=time.monotonic() - accepted,
            feedback=feedback.count,
            # The longest time without feedback: what a user sees of a robot that is not driven.
            silence=max(feedback.longest, time.monotonic() - feedback.last),
        )
        return status

    def _accepted(self, number: int, goal: Any, feedback: _Feedback) -> ClientGoalHandle | None:
        end = time.monotonic() + self._patience.acceptance
        while rclpy.ok() and time.monotonic() < end:
            sent = self._action.send_goal_async(self.message(goal), feedback_callback=feedback.take)
            if not self._wait(sent, end - time.monotonic()):
                return None
            handle: ClientGoalHandle = sent.result()
            identity = bytes(handle.goal_id.uuid).hex()
            self._journal.write(
                "answer", number=number, time=time.time(), accepted=bool(handle.accepted), goal=identity
            )
            if handle.accepted:
                feedback.last = time.monotonic()
                return handle
            self._spin(ASK_AGAIN)
        return None

    def _wait(self, future: Future, seconds: float) -> bool:
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=max(0.0, seconds))
        return bool(future.done())

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while rclpy.ok() and (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self._node, timeout_sec=left)
