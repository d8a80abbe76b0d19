"""The example's route: what it has in it for the tracker to see, and where an instance that begins on the way goes on."""

from __future__ import annotations

import pytest
from tracker_application.route import REST, SPEED, WAYPOINTS, Route, nearest

LIMIT = 1.3
"""m of y beyond which the camera doesn't see the robot's marker."""


@pytest.mark.ros
@pytest.mark.usefixtures("rendering")
def test_a_lap_has_straights_turns_a_stop_and_a_part_outside_the_image():
    from tracker_robot.robot import START, TICK
    from tracker_scene import Scene
    from tracker_scene.driving import Base

    scene = Scene(START)
    base, route = Base(scene), Route()
    fast = turning = resting = away = 0.0
    left: list[float] = []
    try:
        while len(left) < 2:
            assert scene.time < 100, f"out of the picture at {left}"
            before = scene.pose.y
            command = route.command(*scene.pose, scene.time)
            base.command(*command)
            base.step(TICK)
            if before <= LIMIT < scene.pose.y:
                left.append(scene.time)
            if left:
                speed, turn = scene.motion
                fast += TICK * (speed > 0.9 * SPEED)
                turning += TICK * (abs(turn) > 0.5)
                resting += TICK * (command == (0.0, 0.0) and abs(speed) < 0.01)
                away += TICK * (scene.pose.y > LIMIT)
    finally:
        scene.close()
    assert left[1] - left[0] < 40
    assert fast > 8
    assert turning > 3
    assert resting > 0.7 * REST
    assert away > 2, "long enough for the leaf to lose it"


@pytest.mark.parametrize(
    ("place", "expected"), [((-0.6, -0.3), 0), ((0.2, -0.28), 0), ((0.35, 0.45), 1), ((-0.3, 0.6), 2)]
)
def test_an_instance_continues_on_the_present_leg_of_the_robot(place: tuple[float, float], expected: int):
    assert nearest(*place) == expected
    assert Route().command(*place, 0.0, 0.0) != (0.0, 0.0)
    assert expected < len(WAYPOINTS)
