"""The robot in its world: physics at 200 Hz, and what its laser measures."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from navigation_world import Pose, World
from numpy.typing import NDArray

from navigation_robot.model import TRACK, WHEEL_RADIUS, robot_and_world

BEAMS = 360
NEAREST, FARTHEST = 0.1, 8.0
"""The laser's range, in m."""

RANGE_NOISE = 0.01
"""Standard deviation of a range, in m."""

_WORLD_GROUP = 1


class Simulation:
    """One robot in one world. Time is simulated; the caller says how far to go on."""

    def __init__(self, world: World, start: Pose | None = None, random: np.random.Generator | None = None) -> None:
        """``random`` draws the laser's noise; without it every run differs."""
        self._model = mujoco.MjModel.from_xml_string(robot_and_world(world, start or world.start))
        self._data = mujoco.MjData(self._model)
        self._random = random or np.random.default_rng()
        self._body = self._model.body("base").id
        self._laser = self._model.site("laser").id
        self._hull = self._model.geom("hull").id
        self._wheels = [int(self._model.joint(name).qposadr[0]) for name in ("left", "right")]
        self._spins = [int(self._model.joint(name).dofadr[0]) for name in ("left", "right")]
        self.bearings = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
        self._beams = np.stack([np.cos(self.bearings), np.sin(self.bearings), np.zeros(BEAMS)], axis=1)
        self._directions = np.empty((BEAMS, 3))
        self._met = np.empty(BEAMS, np.int32)
        self._distances = np.empty(BEAMS)
        self._groups = np.array([group == _WORLD_GROUP for group in range(mujoco.mjNGROUP)], np.uint8)
        # Down onto its wheels.
        mujoco.mj_step(self._model, self._data, 40)
        self._data.time = 0.0

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self._model.opt.timestep)

    @property
    def time(self) -> float:
        """Simulated seconds since the start."""
        return float(self._data.time)

    def drive(self, speed: float, turn: float) -> None:
        """Ask the motors for a forward speed in m/s and a turn rate in rad/s."""
        self._data.ctrl[0] = (speed - turn * TRACK / 2) / WHEEL_RADIUS
        self._data.ctrl[1] = (speed + turn * TRACK / 2) / WHEEL_RADIUS

    def step(self, steps: int = 1) -> None:
        """Go on by so many timesteps."""
        mujoco.mj_step(self._model, self._data, steps)

    @property
    def wheels(self) -> tuple[float, float]:
        """How far the left and the right wheel have turned, in rad."""
        left, right = self._wheels
        return float(self._data.qpos[left]), float(self._data.qpos[right])

    @property
    def pose(self) -> Pose:
        """Where the robot really is."""
        x, y, _, w, i, j, k = (float(value) for value in self._data.qpos[:7])
        return Pose(x, y, math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)))

    @property
    def motion(self) -> tuple[float, float]:
        """How fast the robot really drives forward, in m/s, and turns, in rad/s."""
        heading = self.pose.heading
        forward = float(self._data.qvel[0]) * math.cos(heading) + float(self._data.qvel[1]) * math.sin(heading)
        return forward, float(self._data.qvel[5])

    @property
    def touching(self) -> bool:
        """Whether the robot's hull touches something."""
        # Nothing else meets the hull.
        return bool((self._data.contact.geom == self._hull).any())

    def scan(self) -> NDArray[np.float32]:
        """One turn of the laser, in m from -pi on, counter-clockwise; ``inf`` where nothing is in its range."""
        rotation = self._data.site_xmat[self._laser].reshape(3, 3)
        np.matmul(self._beams, rotation.T, out=self._directions)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            self._data.site_xpos[self._laser],
            self._directions.ravel(),
            self._groups,
            True,
            self._body,
            self._met,
            self._distances,
            None,
            BEAMS,
            FARTHEST,
        )
        ranges = self._distances + self._random.normal(0.0, RANGE_NOISE, BEAMS)
        seen = (self._met >= 0) & (ranges >= NEAREST) & (ranges <= FARTHEST)
        return np.where(seen, ranges, np.inf).astype(np.float32)
