"""planner_server: ways through the map, by the action /compute_path_to_pose."""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Duration
from nav2_msgs.action import ComputePathToPose
from nav_msgs.msg import OccupancyGrid, Path

from navigation_stack import managed
from navigation_stack.conversions import grid_of, path_message, pose_of
from navigation_stack.planning import GoalBlocked, Inflation, NoPath, Planner, StartBlocked
from navigation_stack.poses import Pose
from navigation_stack.serving import Goal, Outcome, Server
from navigation_stack.whereabouts import Whereabouts

_Result = ComputePathToPose.Result

_CODES: dict[type[Exception], int] = {
    StartBlocked: _Result.START_OCCUPIED,
    GoalBlocked: _Result.GOAL_OCCUPIED,
    NoPath: _Result.NO_VALID_PATH,
}


class PlannerServer(managed.Managed):
    """Plans on /map and shows what it planned on /plan.

    Parameters, named as Nav2's: robot_radius, inflation_radius, cost_scaling_factor, GridBased.tolerance.
    """

    def __init__(self) -> None:
        super().__init__("planner_server")

    def configured(self) -> None:
        self._planner: Planner | None = None
        standard = Inflation()
        self._inflation = Inflation(
            robot_radius=self.parameter("robot_radius", standard.robot_radius),
            inflation_radius=self.parameter("inflation_radius", standard.inflation_radius),
            cost_scaling_factor=self.parameter("cost_scaling_factor", standard.cost_scaling_factor),
        )
        self._tolerance = self.parameter("GridBased.tolerance", 0.25)
        self._frame = self.parameter("global_frame", "map")
        self._whereabouts = Whereabouts(self, odometry=False)
        self._plans = self.create_lifecycle_publisher(Path, "/plan", 1)
        self.at_cleanup(lambda: self.destroy_lifecycle_publisher(self._plans))
        charted = self.create_subscription(OccupancyGrid, "/map", self._charted, managed.LATCHED)
        self.at_cleanup(lambda: self.destroy_subscription(charted))
        Server(self, ComputePathToPose, "/compute_path_to_pose", self._compute)

    def cleaned(self) -> None:
        self._planner = None

    def _charted(self, message: OccupancyGrid) -> None:
        try:
            self._planner = Planner(grid_of(message), self._inflation, tolerance=self._tolerance)
        except ValueError as error:
            self.get_logger().error(f"/map: {error}")

    def _compute(self, goal: Goal) -> tuple[Outcome, Any]:
        began = time.monotonic()
        result = _Result()
        try:
            poses = self._planned(goal.request)
        except (NoPath, ValueError) as error:
            result.error_code = _CODES.get(type(error), _Result.TF_ERROR)
            result.error_msg = str(error)
            self.get_logger().warning(f"no path: {error}")
            return "aborted", result
        result.path = path_message(poses, self._frame, self.get_clock().now().to_msg())
        result.planning_time = Duration(nanosec=min(int((time.monotonic() - began) * 1e9), 10**9 - 1))
        self._plans.publish(result.path)
        return ("canceled" if goal.canceled else "aborted" if goal.over else "succeeded"), result

    def _planned(self, request: Any) -> list[Pose]:
        """Raises NoPath, or ValueError where it is not known what from or what to."""
        planner = self._planner
        if planner is None:
            raise NoPath("there is no map yet")
        for name, message in [("goal", request.goal), *([("start", request.start)] if request.use_start else [])]:
            if message.header.frame_id != self._frame:
                raise ValueError(f"{name}: its frame is '{message.header.frame_id}', it must be {self._frame}")
        if request.use_start:
            start: Pose | None = pose_of(request.start.pose)
        else:
            self._whereabouts.take()
            start = self._whereabouts.pose
        if start is None:
            raise ValueError("it is not known where the robot is: nothing was received on /amcl_pose")
        return planner.plan(start, pose_of(request.goal.pose))


if __name__ == "__main__":
    managed.run(PlannerServer, threads=3)
