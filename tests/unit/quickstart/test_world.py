from __future__ import annotations

import math

import numpy as np
import pytest
from understudy_quickstart.kinematics import Pose
from understudy_quickstart.pursuit import WAYPOINTS, Circuit
from understudy_quickstart.world import ROBOT_RADIUS, START, Box, Pillar, Room, quickstart_room

EAST, NORTH, WEST, SOUTH = 0.0, math.pi / 2, math.pi, -math.pi / 2

ROOM = Room(10.0, 6.0, [Box(4.0, 2.0, 5.0, 3.0)], [Pillar(2.0, 5.0, 0.5)])


def look(pose: Pose, *bearings: float, reach: float = 20.0) -> list[float]:
    return list(ROOM.ray_cast(pose, np.array(bearings), reach))


def test_walls_boxes_and_pillars_are_measured_at_their_distance() -> None:
    assert look(Pose(2.0, 2.5, 0.0), EAST, NORTH, WEST, SOUTH) == pytest.approx([2.0, 2.0, 2.0, 2.5])


def test_bearings_are_relative_to_the_heading() -> None:
    assert look(Pose(2.0, 2.5, NORTH), EAST, WEST) == pytest.approx([2.0, 2.5])


def test_an_oblique_ray_has_the_right_length() -> None:
    assert look(Pose(3.0, 1.5, 0.0), math.atan2(0.75, 1.0)) == pytest.approx([1.25])


def test_only_the_nearest_obstacle_is_measured() -> None:
    assert look(Pose(3.0, 2.5, 0.0), EAST) == pytest.approx([1.0])
    assert look(Pose(3.0, 3.5, 0.0), EAST) == pytest.approx([7.0]), "past the box"


def test_nothing_is_measured_beyond_the_reach() -> None:
    assert look(Pose(2.0, 2.5, 0.0), EAST, SOUTH, reach=2.2) == [pytest.approx(2.0), math.inf]


def test_rays_agree_with_the_clearance() -> None:
    # The least of a dense scan is the distance to the nearest thing, which the map's rule gives by another way.
    room = quickstart_room()
    bearings = np.linspace(-math.pi, math.pi, 2000, endpoint=False)
    for x, y in [(1.2, 1.2), (6.9, 4.9), (1.1, 5.0), (4.0, 4.0), (7.7, 0.3)]:
        scan = room.ray_cast(Pose(x, y, 0.7), bearings, 20.0)
        assert scan.min() == pytest.approx(float(room.clearance(np.array([x]), np.array([y]))[0]), abs=1e-3)


def test_a_robot_fits_only_where_it_touches_nothing() -> None:
    assert ROOM.fits(Pose(3.5, 2.5, 0.0), 0.4)
    assert not ROOM.fits(Pose(3.5, 2.5, 0.0), 0.6)
    assert not ROOM.fits(Pose(4.5, 2.5, 0.0), 0.1), "inside of the box"
    assert not ROOM.fits(Pose(10.2, 2.5, 0.0), 0.1), "outside of the room"


def test_the_map_shows_what_the_laser_sees() -> None:
    grid = ROOM.occupancy(0.1)
    assert grid.shape == (60, 100)
    assert grid[25, 45] == 100, "the box"
    assert grid[50, 20] == 100, "the pillar"
    assert grid[0].min() == grid[-1].min() == grid[:, 0].min() == grid[:, -1].min() == 100, "the walls"
    assert grid[10, 10] == 0


def test_the_circuit_has_clearance_at_every_place() -> None:
    circuit, room = Circuit(WAYPOINTS), quickstart_room()
    assert room.fits(START, ROBOT_RADIUS)
    for place in np.arange(0.0, circuit.length, 0.05):
        assert room.fits(Pose(*circuit.at(float(place)), 0.0), 2 * ROBOT_RADIUS)
