"""amcl: where the robot is on the map, by its laser and its odometry.

It needs the robot's pose once (/initialpose): it searches nearby and nowhere else. Until then it says nothing.
Like Nav2's it takes an initial pose while it is inactive too and uses it when it is activated. Unlike Nav2's it publishes
the pose for each scan, also while the robot stands, so that silence always means that it is lost.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import partial

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from navigation_stack import managed
from navigation_stack.conversions import (
    covariance_of,
    grid_of,
    message_of,
    pose_of,
    scan_of,
    seconds,
    six_by_six,
    transform,
)
from navigation_stack.filter import Motion, ParticleFilter, Sensor
from navigation_stack.grid import Grid
from navigation_stack.lasers import Laser
from navigation_stack.poses import Pose
from navigation_stack.whereabouts import OdometryInput

PERIOD = 0.02
"""s between two looks for a scan: what it costs is far below what a scan costs."""

SETTLING = 15
"""Scans after an initial pose that are used although the robot stands, to find where exactly it is."""

MADE_UP_FOR = 0.03
"""m that an initial pose is doubted by where it is known what was driven since."""

AHEAD = 1.0
"""s that an initial pose may be ahead of odometry. Then odometry is waited for: the sender of the pose has received more."""

_Start = tuple[Pose, Sequence[Sequence[float]], float | None]


class Amcl(managed.Managed):
    """Publishes /amcl_pose, and the transform from map to odom on /tf.

    Parameters, named as Nav2's: max_particles, max_beams, sigma_hit, laser_likelihood_max_dist, update_min_d,
    update_min_a, set_initial_pose, initial_pose.{x,y,yaw}, tf_broadcast, global_frame_id, odom_frame_id, base_frame_id.
    And initial_pose_spread: m that an initial pose is doubted by at least, whatever its covariance says, and headings as much
    in rad, where nobody knows what was driven since: it has no stamp, or one from before this node heard odometry. What was
    driven since a stamp that odometry covers is made up for instead, as Nav2's does.
    """

    def __init__(self) -> None:
        super().__init__("amcl")
        self._guard = threading.Lock()
        self._start: _Start | None = None
        self._told = False

    # -- life -------------------------------------------------------------------------------------------------------

    def configured(self) -> None:
        self._map_frame = self.parameter("global_frame_id", "map")
        self._odom_frame = self.parameter("odom_frame_id", "odom")
        self._least = self.parameter("update_min_d", 0.03), self.parameter("update_min_a", 0.05)
        self._broadcast = self.parameter("tf_broadcast", True)
        self._spread = self.parameter("initial_pose_spread", 0.35)
        self._count = self.parameter("max_particles", 500)
        self._sensor = Sensor(
            beams=self.parameter("max_beams", 90),
            sigma_hit=self.parameter("sigma_hit", 0.08),
            max_distance=self.parameter("laser_likelihood_max_dist", 1.0),
        )
        self._grid: Grid | None = None
        self._filter: ParticleFilter | None = None
        self._used: Pose | None = None
        self._settling, self._begun = 0, False
        self._laser, self._odometry = Laser(self), OdometryInput(self)
        self._poses = self.create_lifecycle_publisher(PoseWithCovarianceStamped, "/amcl_pose", managed.LATCHED)
        self._frames = self.create_lifecycle_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        told = self.create_subscription(PoseWithCovarianceStamped, "/initialpose", self._told_where, 5)
        charted = self.create_subscription(OccupancyGrid, "/map", self._charted, managed.LATCHED)
        for publisher in (self._poses, self._frames):
            self.at_cleanup(partial(self.destroy_lifecycle_publisher, publisher))
        for subscription in (told, charted):
            self.at_cleanup(partial(self.destroy_subscription, subscription))
        if self.parameter("set_initial_pose", False) and not self._told:
            place = [self.parameter(f"initial_pose.{name}", 0.0) for name in ("x", "y", "yaw")]
            self._begin(Pose(*place), np.diag([0.05, 0.05, 0.03]).tolist(), None)

    def activated(self) -> None:
        if self._start is None and self._filter is None:
            self.get_logger().warning("waits for /initialpose: it cannot know where the robot is")
        self._loop = managed.Loop(PERIOD, self._look)

    def deactivated(self) -> None:
        self._loop.stop()

    def cleaned(self) -> None:
        self._filter = self._grid = None

    # -- what is rare -----------------------------------------------------------------------------------------------

    def _told_where(self, message: PoseWithCovarianceStamped) -> None:
        frame = message.header.frame_id
        if frame not in ("", self._map_frame):
            self.get_logger().error(f"/initialpose: its frame is {frame}, it must be {self._map_frame}")
            return
        try:
            pose = pose_of(message.pose.pose)
            stamp = seconds(message.header.stamp)
            self._begin(pose, covariance_of(message.pose.covariance), stamp)
        except ValueError as error:
            self.get_logger().error(f"/initialpose: {error}")
            return
        self._told = True
        self.say(f"told to be at {pose.x:.2f}, {pose.y:.2f}, heading {pose.heading:.2f}")

    def _begin(self, pose: Pose, covariance: Sequence[Sequence[float]], stamp: float | None) -> None:
        with self._guard:
            self._start = pose, covariance, stamp

    def _charted(self, message: OccupancyGrid) -> None:
        try:
            grid = grid_of(message)
        except ValueError as error:
            self.get_logger().error(f"/map: {error}")
            return
        with self._guard:
            same = self._grid is not None and self._grid.cells.shape == grid.cells.shape
            if same and self._grid is not None and (self._grid.cells == grid.cells).all():
                return
            self._grid, self._filter = grid, None
        self.say(f"got a map of {grid.cells.shape[1]} by {grid.cells.shape[0]} cells")

    # -- each scan --------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        self._odometry.take()
        if not self._laser.take():
            return
        stamp = self._laser.time
        with self._guard:
            grid, start = self._grid, self._start
        here = self._odometry.history.at(stamp)
        if grid is None or here is None:
            return
        if start is not None:
            self._begin_at(grid, start, here)
        if self._filter is None or self._used is None:
            return
        self._update(self._filter, here)
        self._publish(here)

    def _begin_at(self, grid: Grid, start: _Start, here: Pose) -> None:
        pose, covariance, stamp = start
        latest = self._odometry.history.latest
        if stamp is not None and latest is not None and 0.0 < stamp - latest[0] < AHEAD:
            return
        # What was driven since then, as far back as odometry is known.
        then = None if stamp is None else self._odometry.history.at(stamp, slack=0.0)
        doubt, turned = (self._spread, self._spread) if then is None else (MADE_UP_FOR, MADE_UP_FOR / 2)
        if then is not None:
            pose = pose.then(then.to(here))
        least, said = np.square([doubt, doubt, turned]), np.asarray(covariance)
        covariance = (said + np.diag(np.maximum(0.0, least - np.diag(said)))).tolist()
        if self._filter is None:
            self._filter = ParticleFilter(grid, particles=self._count, motion=Motion(), sensor=self._sensor)
        self._filter.spread(pose, covariance)
        self._used, self._settling, self._begun = here, SETTLING, True
        with self._guard:
            if self._start is start:
                self._start = None

    def _update(self, particles: ParticleFilter, here: Pose) -> None:
        assert self._used is not None
        step = self._used.to(here)
        distance, angle = self._least
        if not self._settling and abs(step.heading) < angle and step.distance(Pose(0.0, 0.0, 0.0)) < distance:
            return
        self._settling = max(0, self._settling - 1)
        particles.move(step)
        mount = self._laser.mount
        assert mount is not None, "a scan is only told of when it is known"
        particles.sense(*scan_of(self._laser.scan), mount)
        self._used = here

    def _publish(self, here: Pose) -> None:
        assert self._filter is not None
        assert self._used is not None
        estimate, covariance = self._filter.estimate()
        pose = estimate.then(self._used.to(here))
        stamp: Time = self._laser.stamp
        message = PoseWithCovarianceStamped()
        message.header.frame_id, message.header.stamp = self._map_frame, stamp
        message.pose.pose = message_of(pose)
        message.pose.covariance = six_by_six(covariance)
        self._poses.publish(message)
        if self._begun:
            self._begun = False
            self.say(f"localizing from {pose.x:.2f}, {pose.y:.2f}, heading {pose.heading:.2f} at {seconds(stamp):.3f}")
        if self._broadcast:
            origin = pose.then(here.inverse())
            self._frames.publish(TFMessage(transforms=[transform(origin, self._map_frame, self._odom_frame, stamp)]))


if __name__ == "__main__":
    managed.run(Amcl)
