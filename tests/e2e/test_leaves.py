"""Each leaf that looks at an application: it alone fails while the robot is driven as before, and a standby takes over.

One robot fails by leaf after leaf. Its health tree and its procedures are written in XML of BehaviorTree.CPP, those of another one in
OpenSCENARIO 2.
"""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import is_ready
from tests.e2e.observed_robot import SPEED, ObservedRobot
from tests.e2e.scenario import CONTAINER, eventually
from tests.e2e.test_strategies import assert_handed_over

LATE = 1.0
"""Seconds that a command, which comes ten times a second, may be late on a busy machine."""

FAILURES = {
    "xml": {
        "value": "/charge: data was 0.125,",
        "age": "/measured arrived with an age of 60",
        "diagnostics": "status 'drive: motor' is ERROR (hot)",
        "transform": "no transform odom -> base_link on /tf",
        "publisher": "/observed has no publisher of /plan",
    },
    "osc": {
        "log": "observed says ERROR: the motor is hot",
        "node": "node /helper has been missing",
        "progress": "sequence[-1] of /work did not increase by 1",
        "lifecycle": "node /guide is inactive",
        "parameter": f"speed of node /observed is {2 * SPEED:g}",
    },
}
"""What the reason of the recovery contains, by language and leaf."""


def standby(robot: ObservedRobot) -> str:
    """Wait until there is one standby, and the monitor counts on it. Returns its pod."""

    def only_one() -> str | None:
        others = [
            pod["metadata"]["name"]
            for pod in robot.pods()
            if not pod["metadata"].get("deletionTimestamp") and pod["metadata"]["name"] != robot.status().get("active")
        ]
        return others[0] if len(others) == 1 and ready(robot, others[0]) else None

    found: str = eventually(only_one, within=90, what=f"{robot.name} has one standby", note=robot.describe)
    robot.wait_standby()
    return found


def ready(robot: ObservedRobot, pod: str) -> bool:
    """Return whether a pod counts as ready."""
    return is_ready(robot.kubectl.get("pod", pod))


@pytest.mark.parametrize("observed", ["xml"], indirect=True)
@pytest.mark.shows("step/set_parameters", "step/call_service")
def test_an_instance_drives_only_after_a_parameter_was_set_and_a_service_was_called(observed: ObservedRobot) -> None:
    active = observed.wait_protected()
    for pod in (active, standby(observed)):
        said = observed.kubectl("logs", pod, "-c", CONTAINER).splitlines()
        assert f"begin: True, at {SPEED:g}" in said, "its procedure has called the service, after it had set the speed"
    assert {command.linear for command in observed.log().of(active)} == {SPEED}


@pytest.mark.parametrize("observed", ["xml"], indirect=True)
@pytest.mark.parametrize("fault", ["service", "mode"])
@pytest.mark.shows("condition/service_present", "condition/parameter_is")
def test_a_standby_counts_only_while_its_service_is_there_and_its_parameter_is_right(
    observed: ObservedRobot, fault: str
) -> None:
    active = observed.wait_protected()
    waiting = standby(observed)
    observed.break_(waiting, fault)
    eventually(lambda: not ready(observed, waiting), within=30, what=f"{waiting} is not ready", note=observed.describe)
    observed.mend(waiting)  # within the time after which it would be replaced
    observed.wait_standby()
    assert observed.status()["active"] == active, "the robot went on"
    assert observed.recoveries() == []


@pytest.mark.parametrize(
    ("observed", "leaf"),
    [(language, leaf) for language, leaves in FAILURES.items() for leaf in leaves],
    indirect=["observed"],
)
@pytest.mark.shows(
    "leaf/value",
    "leaf/age",
    "leaf/diagnostics",
    "leaf/transform",
    "leaf/publisher",
    "language/xml",
    "leaf/node",
    "leaf/log",
    "leaf/progress",
    "leaf/lifecycle",
    "leaf/parameter",
    "language/osc",
)
def test_one_leaf_fails_while_the_robot_is_driven_and_a_standby_takes_over(observed: ObservedRobot, leaf: str) -> None:
    old = observed.wait_protected()
    next_one = standby(observed)
    observed.break_(old, leaf)
    recovery = observed.wait_recovered(1)
    expected = next(leaves[leaf] for leaves in FAILURES.values() if leaf in leaves)
    assert expected in recovery.reason, recovery
    assert "; " not in recovery.reason, "no other leaf failed"
    assert (recovery.strategy, recovery.old, recovery.new) == ("Fallback/Executing", old, next_one), recovery
    commands = observed.log().of(old)
    assert commands, "it drove"
    assert commands[-1].received > recovery.moments["detected"] - LATE, "and went on driving until that was found"
    assert_handed_over(observed, recovery)
