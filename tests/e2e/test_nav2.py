"""Nav2 itself, which nobody here wrote: its goals survive what happens to it, and the robot gets commands of one stack at a time."""

from __future__ import annotations

import pytest

from tests.e2e.faults import Stage, staying
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.nav2 import MISSING, Nav2, has_image
from tests.e2e.navigation import CONFIGURATIONS
from tests.e2e.test_navigation import DONE, OFTEN, assert_clean, assert_reached

pytestmark = [
    pytest.mark.alone,  # two stacks of ten processes need most of the machine
    pytest.mark.parametrize(
        "configuration",
        [pytest.param(name, marks=() if name in OFTEN else pytest.mark.long) for name in CONFIGURATIONS],
    ),
]


LOCALIZATION = 0.5
"""Metres that Nav2's localization may be off after a hand-over: it corrects itself only every 0.25 m."""


@pytest.fixture
def nav2(kubectl: Kubectl) -> Nav2:
    """A robot with Nav2, which the test still has to set up."""
    if not has_image(kubectl):
        pytest.skip(MISSING)
    return Nav2(kubectl)


def assert_recovered(robot: Nav2, number: int, configuration: str, old: str) -> None:
    """A recovery had the strategy of the configuration, and the new instance knows where the robot is."""
    recovery = robot.wait_recovered(number, within=180)
    assert (recovery.strategy, recovery.old) == (CONFIGURATIONS[configuration], old), recovery
    error = robot.localization_error(recovery.new)
    print(f"{configuration} {number}: {recovery.reason}; off by at most {error:.3f} m in the seconds after")
    assert error < LOCALIZATION
    assert_clean(robot, number)


def test_goals_survive_a_frozen_stack_and_a_killed_controller(nav2: Nav2, configuration: str) -> None:
    nav2.set_up(configuration)
    nav2.wait_protected()
    nav2.send_client(3)
    last = 0
    for number, (signal, *nodes) in enumerate((("STOP",), ("KILL", "controller_server")), 1):
        active = nav2.wait_protected()
        last = nav2.wait_driving(120, beyond=last).number
        nav2.send_signal(active, signal, *nodes)
        assert_recovered(nav2, number, configuration, active)
    assert_reached(nav2, nav2.wait_done(DONE))


@pytest.mark.long
@pytest.mark.local_only
def test_goals_survive_the_loss_of_the_node(nav2: Nav2, configuration: str, stage: Stage) -> None:
    def place(objects: list[Object]) -> None:
        stage.place(staying(objects))

    nav2.set_up(configuration, edit=place)
    active = nav2.wait_protected()
    nav2.send_client(2)
    nav2.wait_driving(120)
    stage.lose(stage.node_of(active), "down")
    assert_recovered(nav2, 1, configuration, active)
    assert_reached(nav2, nav2.wait_done(DONE))
    stage.restore()
