"""The paper's first experiment: the stack is taken away twice while the robot drives through its goals."""

from __future__ import annotations

import re
import time

import pytest

from tests.e2e.faults import Stage, staying
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.navigation import CONFIGURATIONS, GOAL_TOLERANCE, Navigator, Tour
from tests.e2e.scenario import never

pytestmark = [
    pytest.mark.alone,  # a stack of five processes needs most of the machine
    pytest.mark.usefixtures("ends_with_file"),
]

LOCALIZATION = 0.3
"""Metres that localization may be off after a hand-over."""

OFTEN = ("executing",)
"""Configurations that CI drives through; the others are `long`."""

SILENT = 6.0
"""Seconds for which a robot without a goal is looked at: /cmd_vel may be silent for 2.5 s after a goal came, with one 0.5 s."""

DONE = 420.0
"""Seconds for a tour of three goals with what is lost on the way, on a machine that is busy."""


@pytest.fixture
def own_navigator(kubectl: Kubectl) -> Navigator:
    """A robot of the test's own, which the test still has to set up."""
    return Navigator(kubectl)


def assert_reached(navigator: Navigator, tour: Tour) -> None:
    """Every goal was sent once, accepted once, succeeded, and the robot was really there."""
    assert [goal.number for goal in tour.goals] == list(range(1, tour.wanted + 1))
    assert [goal.status for goal in tour.goals] == ["succeeded"] * tour.wanted
    assert [goal.asked for goal in tour.goals] == [1] * tour.wanted, "the client had to ask again"
    assert len({goal.identity for goal in tour.goals}) == tour.wanted
    for goal in tour.goals:
        assert navigator.distance_to(goal) < GOAL_TOLERANCE + LOCALIZATION, goal


def assert_clean(navigator: Navigator, number: int) -> None:
    """At the robot nothing of the new instance came before the switch, and nothing of the old one after it."""
    recovery = navigator.recoveries()[number - 1]
    handover = navigator.log().handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    never(handover.early, "commands of the new instance before the switch")
    never(handover.late, "commands of the old instance after the switch")


@pytest.mark.parametrize(
    "configuration",
    [pytest.param(name, marks=() if name in OFTEN else pytest.mark.long) for name in CONFIGURATIONS],
)
@pytest.mark.shows("step/publish", "step/restore_state", "step/set_lifecycle", "step/wait_for")
def test_all_goals_are_reached_though_the_stack_is_lost_twice(
    request: pytest.FixtureRequest, configuration: str
) -> None:
    if configuration == "executing":
        navigator: Navigator = request.getfixturevalue("navigator")
    else:
        navigator = request.getfixturevalue("own_navigator")
        navigator.set_up(configuration)
        navigator.wait_protected()
    navigator.send_client(3)
    last = 0
    for number, how in enumerate(("deleted-by-force", "frozen"), 1):
        active = navigator.wait_protected()
        last = navigator.wait_driving(120, beyond=last).number
        if how == "frozen":
            navigator.send_signal(active, "STOP")
        else:
            navigator.delete(active, force=True)
        recovery = navigator.wait_recovered(number, within=150)
        assert recovery.strategy == CONFIGURATIONS[configuration], recovery
        assert recovery.old == active
        if configuration != "executing":  # which receives nothing: it has a localization of its own
            first = navigator.first_localization_error(recovery.new, recovery.moments["decided"])
            print(f"{configuration} {number}: the first pose is off by {first:.3f} m; {navigator.carried(number)}")
            assert first < LOCALIZATION
            assert navigator.carried(number) is not None, navigator.condition("StateRestored")
        error = navigator.localization_error(recovery.new)
        print(f"{configuration} {number}: off by at most {error:.3f} m in the seconds after")
        assert error < LOCALIZATION
    tour = navigator.wait_done(DONE)
    assert_reached(navigator, tour)
    for number in (1, 2):
        assert_clean(navigator, number)
    assert not any(task["active"] for task in navigator.status()["tasks"])


@pytest.mark.parametrize(
    ("number", "node", "missed"),
    [
        pytest.param("STOP", "controller_server", "/cmd_vel", id="controller silent", marks=pytest.mark.long),
        pytest.param("KILL", "amcl", "/amcl_pose|/cmd_vel", id="localization dead", marks=pytest.mark.long),
    ],
)
@pytest.mark.shows("leaf/topic")
def test_one_node_that_fails_is_noticed_and_the_goal_is_reached(
    navigator: Navigator, number: str, node: str, missed: str
) -> None:
    active = navigator.wait_protected()
    navigator.send_client(1)
    navigator.wait_driving(120)
    navigator.send_signal(active, number, node)
    recovery = navigator.wait_recovered(1, within=120)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", active)
    assert re.search(missed, recovery.reason), recovery
    assert navigator.localization_error(recovery.new) < LOCALIZATION
    assert_reached(navigator, navigator.wait_done(DONE))
    assert_clean(navigator, 1)


@pytest.mark.local_only
@pytest.mark.long
def test_all_goals_are_reached_though_the_stacks_node_is_lost(own_navigator: Navigator, stage: Stage) -> None:
    navigator = own_navigator

    def place(objects: list[Object]) -> None:
        stage.place(staying(objects))

    navigator.set_up("executing", edit=place)
    active = navigator.wait_protected()
    node = stage.node_of(active)
    navigator.send_client(2)
    navigator.wait_driving(120)
    stage.lose(node, "down")
    recovery = navigator.wait_recovered(1, within=120)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", active)
    assert stage.node_of(recovery.new) != node
    assert navigator.localization_error(recovery.new) < LOCALIZATION
    assert_reached(navigator, navigator.wait_done(DONE))
    assert_clean(navigator, 1)
    stage.restore()


@pytest.mark.long
def test_a_stack_without_a_goal_may_be_silent_and_its_loss_is_detected(own_navigator: Navigator) -> None:
    """Standing still without a goal there is no /cmd_vel, which is no failure; without a heartbeat it is one."""
    navigator = own_navigator

    def only_restart_would_take_long(objects: list[Object]) -> None:
        policy = next(o for o in objects if o["kind"] == "FailurePolicy")
        policy["spec"]["strategies"] = policy["spec"]["strategies"][:1]

    def assert_left_alone(pod: str, recoveries: int) -> None:
        """For many times what /cmd_vel may be silent while there is a goal."""
        time.sleep(SILENT)
        assert len(navigator.recoveries()) == recoveries
        status = navigator.status()
        assert (status["active"], status["health"]) == (pod, "Healthy")

    navigator.set_up("executing", edit=only_restart_would_take_long)
    active = navigator.wait_protected()
    assert_left_alone(active, 0)
    never(navigator.log().of(active), "it drove, and nobody asked it to")
    navigator.send_signal(active, "STOP")
    recovery = navigator.wait_recovered(1, within=120)
    assert recovery.old == active
    assert "/navigation/heartbeat" in recovery.reason or "/amcl_pose" in recovery.reason
    navigator.send_client(1)
    assert_reached(navigator, navigator.wait_done(DONE))
    assert_left_alone(recovery.new, 1)
