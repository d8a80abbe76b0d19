"""Whole trajectories, by the action /arm_controller/follow_joint_trajectory: for planners that do not stream, as MoveIt 2.

The arm goes through the points of one by itself, whether or not who sent it is still there. A newer trajectory, or a
command on the topic, takes its place.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory
from manipulation_arm import JOINTS, Joints
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

_Result = FollowJointTrajectory.Result

STRAY = 0.1
"""rad that a trajectory's beginning may be from where the arm is; one that is farther away is refused."""


class Trajectory:
    """Positions at times, in s from its beginning."""

    def __init__(self, start: Joints, times: list[float], positions: list[Joints]) -> None:
        """It leads from the start to its first point. Raises ValueError where that cannot be followed."""
        if not times or sorted(set(times)) != times or times[0] < 0:
            raise ValueError("times: they must grow from point to point")
        if times[0] < 1e-9 and np.abs(positions[0] - start).max() > STRAY:
            raise ValueError(f"points[0]: it is more than {STRAY} rad from where the arm is")
        lead = times[0] > 1e-9
        self._times = np.array([0.0, *times] if lead else times)
        self._positions = np.stack([start, *positions] if lead else positions)
        self.ended = threading.Event()
        self.done = False

    def at(self, seconds: float) -> Joints:
        """Where the arm should be then; at the end it is done."""
        if seconds >= self._times[-1]:
            self.end(done=True)
        return np.array([np.interp(seconds, self._times, column) for column in self._positions.T])

    def end(self, *, done: bool = False) -> None:
        """It does not count any more."""
        if not self.ended.is_set():
            self.done = done
            self.ended.set()


class Trajectories:
    """The action's server, in a node and a thread of its own. ``follow`` receives each trajectory, ``where`` the position of the arm."""

    def __init__(self, follow: Callable[[Trajectory], None], where: Callable[[], Joints]) -> None:
        self._follow, self._where = follow, where
        self._node = Node("arm_controller_trajectories", start_parameter_services=False)
        self._server = ActionServer(
            self._node,
            FollowJointTrajectory,
            "/arm_controller/follow_joint_trajectory",
            self._execute,
            goal_callback=lambda goal: GoalResponse.ACCEPT if _understood(goal) else GoalResponse.REJECT,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
        )
        self._executor = MultiThreadedExecutor(num_threads=3)
        self._executor.add_node(self._node)
        self._serving = threading.Thread(target=self._serve, daemon=True)
        self._serving.start()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=1)
        self._serving.join(5.0)  # rclpy aborts a process that exits while one of its threads waits
        self._server.destroy()
        self._node.destroy_node()

    def _serve(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def _execute(self, handle: ServerGoalHandle) -> Any:
        points = handle.request.trajectory.points
        times = [point.time_from_start.sec + point.time_from_start.nanosec / 1e9 for point in points]
        try:
            trajectory = Trajectory(self._where(), times, [np.array(point.positions) for point in points])
        except ValueError as error:
            handle.abort()
            return _Result(error_code=_Result.INVALID_GOAL, error_string=str(error))
        self._follow(trajectory)
        while not trajectory.ended.wait(0.02):
            if handle.is_cancel_requested:
                trajectory.end()
        if trajectory.done:
            handle.succeed()
            return _Result(error_code=_Result.SUCCESSFUL)
        if handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return _Result(
            error_code=_Result.PATH_TOLERANCE_VIOLATED, error_string="something else moves the arm, or nothing"
        )


def _understood(goal: Any) -> bool:
    points = goal.trajectory.points
    return list(goal.trajectory.joint_names) == list(JOINTS) and all(len(p.positions) == len(JOINTS) for p in points)
