"""The stack as it runs in its pod, with the simulated robot, as processes over loopback."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from navigation_stack.names import NODES
from navigation_stack.poses import Pose
from navigation_world import generate

from tests.unit.navigation_stack.person import Site

pytestmark = [pytest.mark.ros, pytest.mark.timeout(200)]
for needed in ("rclpy", "nav2_msgs", "tf2_msgs", "mujoco", "navigation_robot"):
    pytest.importorskip(needed)

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
WORLD = generate(7)
START = Pose(WORLD.start.x, WORLD.start.y, WORLD.start.heading)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as cleanup:
        yield Site(tmp_path, cleanup)


def near(pose: Pose, distance: float) -> Pose:
    """A place that is about so far away, straight ahead through open space."""
    for angle in np.linspace(0, math.tau, 48):
        there = pose.then(Pose(0, 0, float(angle))).then(Pose(distance, 0, 0))
        line = np.linspace(0, 1, 20)
        x, y = pose.x + (there.x - pose.x) * line, pose.y + (there.y - pose.y) * line
        if WORLD.clearance(x[3:], y[3:]).min() > 0.4:
            return there
    raise AssertionError(f"nothing is free {distance} m from {pose}")


def test_the_stack_becomes_active_and_reaches_replaces_and_cancels_goals(site: Site) -> None:
    stack = site.module("navigation_stack")
    person = site.person()
    for node in NODES:
        assert site.wait(f"{node} is there", lambda node=node: person.state(node)) == "unconfigured"
    person.bring(site, "configure", "inactive")
    site.wait("somebody listens to /initialpose", lambda: person.localizable)
    person.set_pose(START.then(Pose(0.1, -0.1, 0.1)))
    site.wait("it is heard while inactive", lambda: "told to be at" in site.output("navigation_stack"))
    assert not person.believed
    assert not person.heartbeats
    person.bring(site, "activate", "active")
    site.wait("it knows where it is", lambda: person.off < 0.1)
    site.wait("its heart beats", lambda: person.heartbeats > 3)

    first, second = near(START, 1.2), near(START, 0.6)
    arrived = person.goal(first)
    site.wait("the goal is reached", lambda: arrived.status is not None, within=60)
    assert (arrived.status, arrived.result.error_code) == (SUCCEEDED, 0)
    assert person.truth[-1].distance(first) < 0.25
    assert person.off < 0.15
    assert arrived.feedback
    assert arrived.feedback[-1].number_of_recoveries == 0
    assert arrived.feedback[-1].distance_remaining < 0.6

    # A newer goal takes the place of the one before, also at the controller, and the older one is aborted as in Nav2.
    replaced = person.goal(START)
    site.wait("it drives", lambda: len(replaced.feedback) > 2)
    errand = person.goal(second)
    site.wait("the older goal has ended", lambda: replaced.status is not None)
    assert replaced.status == ABORTED
    site.wait("the newer goal is reached", lambda: errand.status is not None, within=60)
    assert errand.status == SUCCEEDED
    assert person.truth[-1].distance(second) < 0.25

    errand = person.goal(first)
    site.wait("it drives", lambda: len(errand.feedback) > 2)
    errand.cancel()
    site.wait("the goal has ended", lambda: errand.status is not None)
    assert errand.status == CANCELED
    at = site.wait(
        "it stands", lambda: person.truth[-1] if person.truth[-1].distance(person.truth[-5]) < 1e-3 else None
    )
    assert at.distance(first) > 0.05

    nowhere = person.goal(Pose(-30.0, 0.0, 0.0))
    site.wait("it is given up", lambda: nowhere.status is not None)
    assert nowhere.status == ABORTED
    assert nowhere.result.error_code == 206  # GOAL_OCCUPIED of ComputePathToPose
    assert "the goal -30.00, 0.00" in nowhere.result.error_msg

    person.bring(site, "deactivate", "inactive", ["bt_navigator"])
    assert not person.goal(first).accepted
    assert "bumped" not in site.output("navigation_robot")
    stack.send_signal(signal.SIGTERM)
    assert stack.wait(20) == 0
    assert "Traceback" not in site.output("navigation_stack")


def test_a_new_instance_is_not_localized_until_it_receives_the_pose(site: Site) -> None:
    first = site.module("navigation_stack", NAVIGATION_AUTOSTART="1")
    person = site.person()
    site.wait("somebody listens to /initialpose", lambda: person.localizable)
    person.set_pose(START)
    site.wait("it is up", lambda: person.heartbeats > 0)
    site.wait("it knows where it is", lambda: person.off < 0.1)
    goal = near(START, 2.2)
    errand = person.goal(goal)
    site.wait("it drives", lambda: person.truth[-1].distance(START) > 1.6)
    kept = person.believed[-1][1]
    first.kill()
    first.wait(10)
    site.wait("the robot stands", lambda: site.log().motions[-1].held)
    assert errand.status is None

    # What it would do without the kept state: wait, or, told where the robot was at first, believe that.
    person.believed.clear()
    beats = person.heartbeats
    site.module("navigation_stack", NAVIGATION_AUTOSTART="1")
    site.wait("the new one is up", lambda: person.heartbeats > beats)
    lost = person.goal(goal)
    site.wait("it is given up", lambda: lost.status is not None)
    assert lost.status == ABORTED
    assert "it is not known where the robot is" in lost.result.error_msg
    assert not person.believed
    person.set_pose(START)
    site.wait("it believes to be at the start", lambda: len(person.believed) > 20)
    assert person.off > 0.4

    person.restore(kept)
    site.wait("it knows where it is", lambda: person.off < 0.15)
    again = person.goal(goal)
    site.wait("the goal is reached", lambda: again.status is not None, within=60)
    assert again.status == SUCCEEDED
    assert person.truth[-1].distance(goal) < 0.25
    assert "bumped" not in site.output("navigation_robot")
