"""The paper's second experiment: the planner is taken away twice while the arm moves through its poses."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Kubectl
from tests.e2e.manipulation import CONFIGURATIONS, REACHED, Manipulator
from tests.e2e.navigation import Tour

pytestmark = pytest.mark.alone  # the steps of a motion are measured

OFTEN = ("executing",)
"""Configurations that CI moves through; the others are `long`."""

DONE = 240.0
"""Seconds for a tour of three poses with what is lost on the way, on a machine that is busy."""

AROUND = 5.0
"""Seconds before a failure, and after a hand-over, in which steps are looked at."""


@pytest.fixture
def manipulator(kubectl: Kubectl) -> Manipulator:
    return Manipulator(kubectl)


def assert_reached(manipulator: Manipulator, tour: Tour) -> None:
    """Every goal was sent once, accepted once, succeeded, and the gripper was really there."""
    assert [goal.number for goal in tour.goals] == list(range(1, tour.wanted + 1))
    assert [goal.status for goal in tour.goals] == ["succeeded"] * tour.wanted
    assert [goal.asked for goal in tour.goals] == [1] * tour.wanted, "the client had to ask again"
    for goal in tour.goals:
        assert manipulator.distance_to(goal) < REACHED, goal


def assert_no_jump(manipulator: Manipulator, number: int) -> None:
    """At the arm control passed cleanly, and no joint was sent farther than twice the most of an undisturbed motion."""
    recovery = manipulator.recoveries()[number - 1]
    log = manipulator.log()
    handover = log.handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    assert not handover.early, handover
    assert not handover.late, handover
    assert handover.first_new is not None
    assert handover.last_old is not None
    undisturbed = log.largest_step(handover.last_old - AROUND, handover.last_old)
    around = log.largest_step(handover.first_new, handover.first_new + AROUND)
    first = log.steps[handover.first_new]
    steps = [(round(c.sent - handover.first_new, 3), round(c.received - handover.first_new, 3), log.steps[c.received])
             for c in log.of(recovery.new) if c.received < handover.first_new + 0.2]  # fmt: skip
    print(f"{number}: gap {handover.gap:.3f} s, first step {first:.4f}, largest around {around:.4f}, "
          f"undisturbed {undisturbed:.4f} rad; by times of sending and reception: {steps}")  # fmt: skip
    assert first <= around <= 2 * undisturbed


@pytest.mark.parametrize(
    "configuration",
    [pytest.param(name, marks=() if name in OFTEN else pytest.mark.long) for name in CONFIGURATIONS],
)
def test_the_motion_is_completed_without_a_jump_though_the_planner_is_lost_twice(
    manipulator: Manipulator, configuration: str
) -> None:
    manipulator.set_up(configuration)
    manipulator.wait_protected()
    manipulator.send_client(3)
    last = 0
    for number, how in enumerate(("deleted-by-force", "frozen"), 1):
        active = manipulator.wait_protected()
        last = manipulator.wait_driving(120, beyond=last).number
        if how == "frozen":
            manipulator.send_signal(active, "STOP")
        else:
            manipulator.delete(active, force=True)
        recovery = manipulator.wait_recovered(number, within=120)
        assert recovery.strategy == CONFIGURATIONS[configuration], recovery
        assert recovery.old == active
    tour = manipulator.wait_done(DONE)
    assert_reached(manipulator, tour)
    for number in (1, 2):
        assert_no_jump(manipulator, number)
    assert manipulator.log().bumps == 0
    assert not any(task["active"] for task in manipulator.status()["tasks"])
