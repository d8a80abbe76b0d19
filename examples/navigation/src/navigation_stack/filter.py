"""Monte Carlo localization: a particle filter with odometry motion and a likelihood field of laser ranges.

As Nav2's AMCL does it with ``likelihood_field`` (Thrun, Burgard, Fox: Probabilistic Robotics, ch. 5.4 and 6.4). The number
of particles is fixed: without a global search there is no need for more of them at times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from navigation_stack.grid import Grid, distances
from navigation_stack.poses import Pose, wrapped


@dataclass(frozen=True, slots=True)
class Motion:
    """How far odometry may be off. Fractions of what was moved; too little makes the filter stick beside the truth."""

    turn: float = 0.08
    """Standard deviation of a turn, for each rad of it."""
    drift: float = 0.05
    """Standard deviation of the heading in rad, for each m."""
    distance: float = 0.08
    """Standard deviation of a distance, for each m of it."""
    floor: float = 0.003
    """Standard deviation that each update has at least, in m and rad."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """How laser ranges are believed; names as in AMCL."""

    beams: int = 90
    sigma_hit: float = 0.08
    z_hit: float = 0.85
    z_rand: float = 0.15
    max_distance: float = 1.0
    """Beyond this distance to an obstacle, in m, an end point is as unlikely as it gets."""
    trust: float = 0.25
    """Weight of one beam's log likelihood: neighbouring beams see the same wall and are no independent witnesses."""
    tail: float = 0.02
    """Likelihood of a beam that ends nowhere near the map, at least (people, furniture)."""


FIRST = 4
"""Times as many particles as later, around a given pose."""


class ParticleFilter:
    """Where the robot may be, as weighted particles in the map frame."""

    def __init__(
        self,
        grid: Grid,
        *,
        particles: int = 400,
        motion: Motion | None = None,
        sensor: Sensor | None = None,
        seed: int | None = None,
    ) -> None:
        self._motion, self._sensor = motion or Motion(), sensor or Sensor()
        self._random = np.random.default_rng(seed)
        self._grid = grid
        field = distances(grid.obstacles, grid.resolution, self._sensor.max_distance)
        hit = self._sensor.z_hit * np.exp(-0.5 * (field / self._sensor.sigma_hit) ** 2)
        self._likelihood = (
            np.log(np.maximum(hit + self._sensor.z_rand * 0.1, self._sensor.tail)).astype(np.float32).ravel()
        )
        self._nowhere = float(self._likelihood.min())
        self._count = particles
        self._particles: NDArray[np.float64] = np.zeros((particles, 3))
        self._weights: NDArray[np.float64] = np.full(particles, 1 / particles)

    def spread(self, pose: Pose, covariance: Sequence[Sequence[float]]) -> None:
        """Begin again around a pose; the covariance is of x, y and heading."""
        matrix = np.asarray(covariance, dtype=float)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError(f"covariance: a finite 3 by 3 matrix is needed, found {matrix.tolist()}")
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        # More at first, until scans have told the good ones: a wide doubt is covered as densely as a narrow one.
        many = FIRST * self._count
        steps = self._random.normal(size=(many, 3)) * np.sqrt(np.maximum(values, 0.0))
        self._particles = np.array(pose) + steps @ vectors.T
        self._weights = np.full(many, 1 / many)

    def move(self, step: Pose) -> None:
        """The robot moved by so much in its own frame, by its odometry."""
        m, n = self._motion, len(self._particles)
        length = math.hypot(step.x, step.y)
        bearing = math.atan2(step.y, step.x) if length > 1e-6 else 0.0
        turn = abs(step.heading)
        lengths = length + self._random.normal(0.0, m.distance * length + m.floor, n)
        turns = step.heading + self._random.normal(0.0, m.turn * turn + m.drift * length + m.floor, n)
        headings = self._particles[:, 2]
        # ``bearing`` is half of the turn on an arc, so that the step is the chord.
        toward = headings + bearing + (turns - step.heading) / 2
        self._particles[:, 0] += lengths * np.cos(toward)
        self._particles[:, 1] += lengths * np.sin(toward)
        headings += turns

    def sense(self, ranges: NDArray[np.float32], bearings: NDArray[np.float32], mount: Pose) -> None:
        """Weigh the particles by a scan: ranges in m at bearings in rad of a laser that is mounted so on the robot."""
        every = max(1, len(ranges) // self._sensor.beams)
        ranges, bearings = ranges[::every], bearings[::every]
        seen = np.isfinite(ranges)
        if not seen.any():
            return
        ranges, angles = ranges[seen], bearings[seen] + np.float32(mount.heading)
        ahead = (ranges * np.cos(angles) + mount.x) / self._grid.resolution
        left = (ranges * np.sin(angles) + mount.y) / self._grid.resolution
        rows, columns = self._grid.cells.shape
        place = self._particles.astype(np.float32)
        c, s = np.cos(place[:, 2, None]), np.sin(place[:, 2, None])
        column = (c * ahead - s * left + (place[:, 0, None] - np.float32(self._grid.x)) / self._grid.resolution).astype(
            np.int32
        )
        row = (s * ahead + c * left + (place[:, 1, None] - np.float32(self._grid.y)) / self._grid.resolution).astype(
            np.int32
        )
        outside = (column < 0) | (row < 0) | (column >= columns) | (row >= rows)
        row *= columns
        row += column
        row[outside] = 0
        found = self._likelihood[row]
        found[outside] = self._nowhere
        scores = self._sensor.trust * found.sum(axis=1, dtype=np.float64)
        weights = self._weights * np.exp(scores - scores.max())
        self._weights = weights / weights.sum()
        if 1 / np.square(self._weights).sum() < len(self._weights) / 2:
            self._resample()

    def estimate(self) -> tuple[Pose, NDArray[np.float64]]:
        """The mean pose, and the covariance of x, y and heading."""
        w, p = self._weights, self._particles
        x, y = float(w @ p[:, 0]), float(w @ p[:, 1])
        heading = math.atan2(float(w @ np.sin(p[:, 2])), float(w @ np.cos(p[:, 2])))
        off = np.column_stack([p[:, 0] - x, p[:, 1] - y, np.remainder(p[:, 2] - heading + np.pi, math.tau) - np.pi])
        return Pose(x, y, wrapped(heading)), (off * w[:, None]).T @ off

    def _resample(self) -> None:
        # Low variance: one random number for all, so that equal weights keep every particle.
        points = (self._random.random() + np.arange(self._count)) / self._count
        chosen = np.searchsorted(np.cumsum(self._weights), points).clip(0, len(self._weights) - 1)
        self._particles = self._particles[chosen]
        self._weights = np.full(self._count, 1 / self._count)
