"""The paper's second experiment: commands are remapped, so that all looks healthy from inside while the robot stands.

The camera's images are rendered by the robot's simulation, and its marker is found in them by the tracker.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left

import pytest
from understudy_demo.robotview import Motion, RobotLog

from tests.e2e.kubectl import Kubectl
from tests.e2e.supervision import FAST, Sighting, Supervised

WITHIN = 90.0
"""Seconds for a lap of half a minute, on a machine that is busy."""

SEEN = 5
"""How often the robot is seen to drive, at least."""

BEYOND = 1.3
"""m of y from which on the camera doesn't see the robot's marker."""

NEAR = 0.05
"""m between where the robot is seen and where it was at most a twentieth of a second before or after."""

COMMANDS = 20.0
"""Hz."""

SOON = 4.0
"""Seconds until it is found that the robot stands; on a machine of its own it takes one."""


def stands(motion: Motion) -> bool:
    return abs(motion.speed) < 0.03 and abs(motion.turn) < 0.1


def assert_seen_as_it_is(seen: list[Sighting], log: RobotLog) -> None:
    """Wherever the robot is seen is where it was by its own log."""
    times = [motion.time for motion in log.motions]
    for sighting in seen:
        index = bisect_left(times, sighting.stamp)
        near = min(log.motions[max(0, index - 1) : index + 1], key=lambda m: abs(m.time - sighting.stamp))
        assert abs(near.time - sighting.stamp) < 0.2, f"the robot's log has nothing of {sighting}"
        assert math.hypot(near.x - sighting.x, near.y - sighting.y) < NEAR, (sighting, near)


def assert_ordinary(motions: list[Motion]) -> None:
    """It has turned, left the picture, come back and rested."""
    away = [index for index, motion in enumerate(motions) if motion.y > BEYOND]
    assert away, "it was out of the picture"
    back = motions[away[-1] :]
    assert any(abs(motion.turn) > 0.5 for motion in back)
    assert any(stands(motion) for motion in back)


@pytest.mark.alone  # images are drawn, sent and searched, which needs most of the machine
@pytest.mark.parametrize(
    ("strategies", "expected"),
    [
        pytest.param(slice(None), "Fallback/Executing", id="executing"),
        pytest.param(slice(1, None), "Restart", id="restart", marks=pytest.mark.long),
    ],
)
@pytest.mark.shows("leaf/motion")
def test_a_robot_that_stands_while_all_is_well_inside_is_seen_and_drives_again(
    kubectl: Kubectl, strategies: slice, expected: str
) -> None:
    robot = Supervised(kubectl)
    robot.set_up(strategies)
    robot.wait_driven()
    seen = robot.look(WITHIN, driving=SEEN, again=True)
    old = robot.wait_protected()
    robot.wait_straight()
    told = robot.log(tail=20).motions[-1].time
    robot.misremap(old)
    recovery = robot.wait_recovered(1, within=150)

    log = robot.log()
    assert_seen_as_it_is(seen, log)
    assert_ordinary([motion for motion in log.motions if motion.time < told])
    detected = recovery.moments["detected"]
    assert detected > told, f"it stopped, turned and left the picture, and none of that is a failure: {recovery}"
    assert (recovery.strategy, recovery.old) == (expected, old), robot.describe()
    assert re.fullmatch(
        r"the robot does not move as /cmd_vel_nav commands, according to /tracker/robot/odometry: (forward|turning) [^;]*",
        recovery.reason,
    ), f"nothing else was found wrong: {recovery}"

    # Until then commands went on to come to the robot, and said nothing of what was decided.
    stood = detected
    for motion in reversed([motion for motion in log.motions if told < motion.time < detected]):
        if not stands(motion):
            break
        stood = motion.time
    print(f"\n{expected}: seen {detected - stood:.2f} s after it stood; {recovery.reason}")
    assert 0 < detected - stood < SOON
    still = [command for command in log.of(old) if stood <= command.received < detected]
    assert len(still) >= COMMANDS * (detected - stood) / 2
    assert {(command.linear, command.angular) for command in still} == {(0.0, 0.0)}

    # And then it drives, by another instance, as the camera and its own log say.
    assert recovery.problems(recovery.handover(log), strategy=expected) == []
    seen = robot.look(WITHIN, driving=SEEN)
    log = robot.log()
    assert_seen_as_it_is(seen, log)
    assert any(motion.speed > FAST for motion in log.motions if motion.time > recovery.moments["routed"])
    assert robot.wait_driven() == recovery.new
    assert len(robot.recoveries()) == 1, robot.describe()
