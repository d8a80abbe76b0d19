"""bt_navigator: brings the robot to a pose, by the action /navigate_to_pose.

As Nav2's default tree does it: plan, follow, plan again each second; after a failure recover and try again, so many
times and no more. If the map shows no way, it is given up at once: the map will not change. A newer goal
takes the place of the one before, which is aborted, and the robot drives on meanwhile. While it is active it publishes
/navigation/heartbeat, so that its loss is noticed also when there is nothing to do.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from nav2_msgs.action import ComputePathToPose, FollowPath, NavigateToPose
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future

from navigation_stack import managed
from navigation_stack.conversions import pose_of, stamped
from navigation_stack.heartbeats import Heartbeat
from navigation_stack.serving import Goal, Outcome, Server, until
from navigation_stack.whereabouts import Whereabouts

_Result = NavigateToPose.Result

FEEDBACK = 0.25
"""s between two messages of feedback."""

UNKNOWN = 9000
"""Error code where the cause has none of its own (Nav2 gives the navigator codes from 9000)."""


_Plan = ComputePathToPose.Result
_FINAL = {_Plan.GOAL_OCCUPIED, _Plan.GOAL_OUTSIDE_MAP, _Plan.NO_VALID_PATH}
"""Error codes of the planner that another try will not change."""


class _Failed(Exception):
    """A step failed; a code and why."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


class _Following:
    """The controller's goals of one navigation: a newer path takes the place of the one before."""

    def __init__(self, client: ActionClient) -> None:
        self._client = client
        self._guard = threading.Lock()
        self._number = 0
        self._handle: ClientGoalHandle | None = None
        self.ended = threading.Event()
        self.outcome: tuple[int, int, str] = (GoalStatus.STATUS_UNKNOWN, 0, "")
        self.distance = 0.0
        self.speed = 0.0

    def follow(self, goal: FollowPath.Goal) -> None:
        """Follow this path from now on."""
        with self._guard:
            self._number += 1
            number = self._number
            self.ended.clear()
        sent = self._client.send_goal_async(goal, feedback_callback=self._fed_back)
        sent.add_done_callback(lambda future: self._answered(number, future))

    def stop(self) -> None:
        """Cancel it, if there is anything to cancel."""
        with self._guard:
            self._number += 1
            handle, self._handle = self._handle, None
        if handle is not None:
            handle.cancel_goal_async()

    def _fed_back(self, message: Any) -> None:
        self.distance, self.speed = message.feedback.distance_to_goal, message.feedback.speed

    def _answered(self, number: int, future: Future) -> None:
        handle = future.result()
        with self._guard:
            current = number == self._number
            if current and handle.accepted:
                self._handle = handle
        if not handle.accepted:
            self._end(number, (GoalStatus.STATUS_ABORTED, UNKNOWN, "the controller refuses the path: is it active?"))
        elif current:
            handle.get_result_async().add_done_callback(lambda result: self._resulted(number, result))
        else:  # stopped before the answer came, or a newer path is under way, to which this is none
            handle.cancel_goal_async()

    def _resulted(self, number: int, future: Future) -> None:
        answer = future.result()
        self._end(number, (answer.status, answer.result.error_code, answer.result.error_msg))

    def _end(self, number: int, outcome: tuple[int, int, str]) -> None:
        with self._guard:
            # Arrived is arrived, whichever of the paths to the goal it was; all else is only of interest of the newest.
            if number != self._number and outcome[0] != GoalStatus.STATUS_SUCCEEDED:
                return
            self.outcome = outcome
        self.ended.set()


class Navigator(managed.Managed):
    """The navigator.

    Parameters: number_of_retries (recoveries for each goal, as in Nav2's default tree), replan_period, wait_duration (s
    that a recovery lasts), server_timeout (s that a plan may take), global_frame.
    """

    def __init__(self) -> None:
        super().__init__("bt_navigator")

    def configured(self) -> None:
        self._retries = self.parameter("number_of_retries", 6)
        self._replan = self.parameter("replan_period", 1.0)
        self._wait = self.parameter("wait_duration", 1.0)
        self._timeout = self.parameter("server_timeout", 2.0)
        self._frame = self.parameter("global_frame", "map")
        self._whereabouts = Whereabouts(self, odometry=False)
        self._planner = ActionClient(self, ComputePathToPose, "/compute_path_to_pose")
        self._controller = ActionClient(self, FollowPath, "/follow_path")
        self._heartbeat = Heartbeat(self, "/navigation/heartbeat")
        self.at_cleanup(self._planner.destroy)
        self.at_cleanup(self._controller.destroy)
        Server(self, NavigateToPose, "/navigate_to_pose", self._navigate)

    def activated(self) -> None:
        self._heartbeat.begin()

    def deactivated(self) -> None:
        self._heartbeat.stop()

    # -- a goal -----------------------------------------------------------------------------------------------------

    def _navigate(self, goal: Goal) -> tuple[Outcome, Any]:
        result = _Result()
        following = _Following(self._controller)
        recoveries = 0
        try:
            target = self._target(goal)
            self.say(f"to {target.pose.position.x:.2f}, {target.pose.position.y:.2f}")
            journey = _Journey(self, goal, target, following)
            while not goal.over:
                try:
                    journey.attempt(recoveries)
                    break
                except _Failed as failure:
                    if recoveries >= self._retries or failure.code in _FINAL:
                        raise
                    recoveries += 1
                    self.get_logger().warning(f"recovery {recoveries} of {self._retries}: {failure}")
                    following.stop()
                    until(threading.Event(), goal, self._wait)
        except _Failed as failure:
            result.error_code, result.error_msg = failure.code, str(failure)
            self.get_logger().error(f"given up: {failure}")
        if goal.superseded and not goal.canceled and self.active:
            return "aborted", result  # the newer goal's path takes the place of this one's, without a halt
        following.stop()
        if goal.over:
            return "canceled" if goal.canceled else "aborted", result
        if result.error_code == _Result.NONE:
            self.say("arrived")
        return "succeeded" if result.error_code == _Result.NONE else "aborted", result

    def _target(self, goal: Goal) -> Any:
        target = goal.request.pose
        if target.header.frame_id != self._frame:
            raise _Failed(UNKNOWN, f"goal: its frame is '{target.header.frame_id}', it must be {self._frame}")
        try:
            pose_of(target.pose)
        except ValueError as error:
            raise _Failed(UNKNOWN, f"goal: {error}") from None
        return target

    def path(self, target: Any, goal: Goal) -> Any:
        """A path to the target; None where the goal is over meanwhile, or nobody answers. Raises _Failed."""
        answered, box = threading.Event(), [None]

        def resulted(future: Future) -> None:
            box[0] = future.result()
            answered.set()

        def accepted(future: Future) -> None:
            handle = future.result()
            if handle.accepted:
                handle.get_result_async().add_done_callback(resulted)
            else:
                answered.set()

        self._planner.send_goal_async(ComputePathToPose.Goal(goal=target)).add_done_callback(accepted)
        if not until(answered, goal, self._timeout):
            return None
        answer: Any = box[0]
        if answer is None:
            raise _Failed(UNKNOWN, "the planner refuses the goal: is it active?")
        if answer.status == GoalStatus.STATUS_SUCCEEDED:
            return answer.result.path
        if goal.over or answer.result.error_code == ComputePathToPose.Result.NONE:
            return None  # superseded at the planner by a newer goal's
        raise _Failed(answer.result.error_code, answer.result.error_msg)

    @property
    def pose(self) -> Any:
        """Where the robot is."""
        self._whereabouts.take()
        pose = self._whereabouts.pose
        return None if pose is None else stamped(pose, self._frame, self.get_clock().now().to_msg())

    @property
    def replan_period(self) -> float:
        """s between two plans."""
        return float(self._replan)


class _Journey:
    """One goal's way, over all of its attempts."""

    def __init__(self, navigator: Navigator, goal: Goal, target: Any, following: _Following) -> None:
        self._navigator, self._goal, self._target, self._following = navigator, goal, target, following
        self._began = time.monotonic()

    def attempt(self, recoveries: int) -> None:
        """Drive there; returns when it has arrived, or the goal is over. Raises _Failed."""
        path = self._navigator.path(self._target, self._goal)
        if path is None:
            if self._goal.over:
                return
            raise _Failed(ComputePathToPose.Result.TIMEOUT, "the planner does not answer")
        self._follow(path)
        planned = told = time.monotonic()
        while not until(self._following.ended, self._goal, FEEDBACK):
            if self._goal.over:
                return
            now = time.monotonic()
            if now - planned >= self._navigator.replan_period:
                planned = now
                self._plan_again()
            if now - told >= FEEDBACK:
                told = now
                self._feed_back(recoveries)
        status, code, why = self._following.outcome
        if status != GoalStatus.STATUS_SUCCEEDED and not self._goal.over:
            raise _Failed(code or UNKNOWN, why or "the controller gave up")

    def _plan_again(self) -> None:
        try:
            path = self._navigator.path(self._target, self._goal)
        except _Failed as failure:  # the old path is still as good as it was; what is in the way the controller sees
            self._navigator.get_logger().warning(f"no newer path: {failure}")
            return
        if path is not None and not self._following.ended.is_set():
            self._follow(path)

    def _follow(self, path: Any) -> None:
        self._following.follow(FollowPath.Goal(path=path))

    def _feed_back(self, recoveries: int) -> None:
        pose = self._navigator.pose
        if pose is None:
            return
        feedback = NavigateToPose.Feedback(number_of_recoveries=recoveries, current_pose=pose)
        feedback.distance_remaining = self._following.distance
        feedback.navigation_time = _duration(time.monotonic() - self._began)
        feedback.estimated_time_remaining = _duration(self._following.distance / max(abs(self._following.speed), 0.1))
        self._goal.feedback(feedback)


def _duration(seconds: float) -> Duration:
    return Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))


if __name__ == "__main__":
    managed.run(Navigator, threads=6)
