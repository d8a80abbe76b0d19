from __future__ import annotations

import math

import pytest
from understudy_quickstart.kinematics import Base, Pose
from understudy_quickstart.pursuit import WAYPOINTS, Circuit, Pursuit, space_ahead

SQUARE = Circuit([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)])


def test_a_circuit_has_a_position_for_each_distance() -> None:
    assert SQUARE.length == pytest.approx(8.0)
    assert SQUARE.at(1.0) == pytest.approx((1.0, 0.0))
    assert SQUARE.at(5.5) == pytest.approx((0.5, 2.0))
    assert SQUARE.at(8.5) == pytest.approx((0.5, 0.0)), "goes on from the beginning"


@pytest.mark.parametrize(
    ("point", "place"),
    [((1.0, -0.4), 1.0), ((2.3, 1.0), 3.0), ((-5.0, 1.0), 7.0), ((-1.0, -1.0), 0.0), ((0.1, 1.0), 7.0)],
)
def test_the_nearest_place_of_the_circuit_is_found(point: tuple[float, float], place: float) -> None:
    assert SQUARE.nearest(*point) == pytest.approx(place)


@pytest.mark.parametrize(("place", "number"), [(0.0, 1), (1.9, 1), (2.1, 2), (5.9, 3), (6.1, 0), (8.1, 1)])
def test_the_waypoint_after_a_place_is_found(place: float, number: int) -> None:
    assert SQUARE.waypoint_after(place) == number


def test_a_circuit_of_one_point_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2 waypoints, found 1"):
        Circuit([(0.0, 0.0)])


def test_the_robot_drives_straight_on_the_line() -> None:
    linear, angular = Pursuit(SQUARE, speed=0.5).command(Pose(0.5, 0.0, 0.0), math.inf)
    assert linear == pytest.approx(0.5)
    assert angular == pytest.approx(0.0)


def test_the_robot_turns_back_to_the_line() -> None:
    pursuit = Pursuit(SQUARE)
    assert pursuit.command(Pose(0.5, 0.2, 0.0), math.inf)[1] < 0 < pursuit.command(Pose(0.5, -0.2, 0.0), math.inf)[1]


def test_the_robot_turns_on_the_spot_if_it_faces_away() -> None:
    linear, angular = Pursuit(SQUARE).command(Pose(0.5, 0.0, math.pi * 0.9), math.inf)
    assert linear == 0.0
    assert angular < -0.5, "the short way round"


@pytest.mark.parametrize(("ahead", "speed"), [(math.inf, 0.5), (0.8, 0.5), (0.55, 0.25), (0.3, 0.0), (0.1, 0.0)])
def test_the_robot_slows_down_and_stops_before_an_obstacle(ahead: float, speed: float) -> None:
    pursuit = Pursuit(SQUARE, speed=0.5, stop_at=0.3, slow_from=0.8)
    assert pursuit.command(Pose(0.5, 0.0, 0.0), ahead)[0] == pytest.approx(speed)


def test_only_obstacles_in_the_cone_ahead_count() -> None:
    ranges = [0.1, 0.1, 0.9, 0.7, math.inf, 0.1]
    assert space_ahead(ranges, -0.6, 0.2, cone=0.3) == 0.7
    assert space_ahead([math.inf] * 6, -0.6, 0.2) == math.inf


def lap(start: Pose, seconds: float) -> tuple[list[int], float]:
    """Drive with the real base; the waypoints in the order they came next, and the largest distance from the line."""
    circuit = Circuit(WAYPOINTS)
    pursuit = Pursuit(circuit)
    base = Base(start, now=0.0)
    order: list[int] = []
    farthest = 0.0
    for step in range(round(seconds * 50)):
        now = step / 50
        pose = base.pose
        place = circuit.nearest(pose.x, pose.y)
        x, y = circuit.at(place)
        farthest = max(farthest, math.hypot(x - pose.x, y - pose.y))
        if step % 2 == 0:
            base.command(*pursuit.command(pose, math.inf), now=now)
        number = circuit.waypoint_after(place)
        if not order or order[-1] != number:
            order.append(number)
        base.place(base.step(now))
    return order, farthest


def test_laps_pass_all_waypoints_in_order() -> None:
    order, farthest = lap(Pose(1.2, 1.2, 0.0), 80.0)
    assert order[:10] == [1, 2, 3, 4, 5, 6, 7, 0, 1, 2]
    assert len(order) > 16, "two laps"
    assert farthest < 0.25


def test_a_new_instance_continues_from_the_position_of_the_robot() -> None:
    # It keeps no state: put down beside the far side of the circuit, it drives on from there.
    order, _ = lap(Pose(5.0, 4.9, math.pi), 12.0)
    assert order[:3] == [5, 6, 7]
