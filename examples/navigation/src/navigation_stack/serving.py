"""Action servers of which one goal counts at a time: a newer one takes the place of the one before, as in Nav2."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from typing import Any, Literal

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from navigation_stack.managed import Managed

Outcome = Literal["succeeded", "aborted", "canceled"]

RESULT_TIMEOUT = 30
"""s for which results are kept."""


class Goal:
    """A goal that is worked on."""

    def __init__(self, server: Server, handle: ServerGoalHandle) -> None:
        self._server, self._handle = server, handle
        self.request: Any = handle.request

    @property
    def canceled(self) -> bool:
        """Whether it is asked to be canceled."""
        return bool(self._handle.is_cancel_requested)

    @property
    def superseded(self) -> bool:
        """Whether a newer goal has taken its place."""
        return self._server.current is not self._handle

    @property
    def over(self) -> bool:
        """Whether there is no more reason to work on it."""
        return self.canceled or self.superseded or not self._server.node.active

    def feedback(self, message: Any) -> None:
        """Tell the client."""
        if self._handle.is_active:
            self._handle.publish_feedback(message)


class Server:
    """An action of a managed node. Each goal is worked on in a thread; work ends soon after its goal is ``over``."""

    def __init__(self, node: Managed, kind: Any, name: str, work: Callable[[Goal], tuple[Outcome, Any]]) -> None:
        self.node = node
        self.current: ServerGoalHandle | None = None
        self._kind, self._work = kind, work
        self._server = ActionServer(
            node,
            kind,
            name,
            self._execute,
            goal_callback=lambda request: GoalResponse.ACCEPT if node.active else GoalResponse.REJECT,
            handle_accepted_callback=self._accepted,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
            result_timeout=RESULT_TIMEOUT,
        )
        node.at_cleanup(self._server.destroy)

    def _accepted(self, handle: ServerGoalHandle) -> None:
        self.current = handle
        handle.execute()

    def _execute(self, handle: ServerGoalHandle) -> Any:
        goal = Goal(self, handle)
        try:
            outcome, result = self._work(goal)
        except Exception:  # a goal must have an end, whatever happens
            self.node.get_logger().error(traceback.format_exc())
            outcome, result = "aborted", self._kind.Result()
        if outcome == "succeeded":
            handle.succeed()
        elif outcome == "canceled" and goal.canceled:
            handle.canceled()
        else:
            handle.abort()
        return result


def until(event: threading.Event, goal: Goal, within: float) -> bool:
    """Wait for an event while the goal counts; whether it came."""
    left = within
    while left > 0 and not goal.over:
        if event.wait(min(0.05, left)):
            return True
        left -= 0.05
    return event.is_set()
