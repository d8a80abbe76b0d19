"""A node is lost to Kubernetes, seen from the robot: with what runs there, or only with its kubelet and container runtime."""

from __future__ import annotations

import signal
import time

import pytest

from tests.e2e.faults import Stage, signal_processes
from tests.e2e.scenario import APPLICATION, Late, Robot, eventually, never
from tests.e2e.test_strategies import assert_handed_over

pytestmark = pytest.mark.local_only

UNDISTURBED = 1.0
"""Seconds without a command below which the robot counts as driven all the time, on a machine that is busy."""


def assert_undisturbed(robot: Robot, active: str, since: float) -> None:
    """The robot has been driven by one pod all the time."""
    assert robot.recoveries() == []
    log = robot.log().between(since - 1, time.time())
    assert set(log.sources()) == {active}
    assert log.commands[-1].received > time.time() - 5
    if (silence := log.longest_silence()) is not None and silence.seconds > UNDISTURBED:
        raise Late(f"the robot had no command for {silence.seconds:.2f} s")


def assert_it_stays_so(robot: Robot, stage: Stage, old: str, new: str) -> None:
    """When the node is back, its pod goes, and never drives again."""
    stage.restore()
    eventually(lambda: not robot.has_pod(old), within=120, what=f"{old} is gone", note=robot.describe)
    assert robot.status()["active"] == new
    assert len(robot.recoveries()) == 1
    log = robot.log()
    never(log.returns(), "the lost pod drives again")
    assert log.commands[-1].source == new
    assert log.commands[-1].received > time.time() - 3


@pytest.mark.long
def test_the_node_of_the_pod_in_control_loses_its_power(apart: Robot, stage: Stage) -> None:
    old = apart.wait_protected()
    node = stage.node_of(old)
    stage.lose(node, "down")
    recovery = apart.wait_recovered(1)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", old), recovery
    assert_handed_over(apart, recovery)
    assert stage.node_of(recovery.new) != node
    assert_it_stays_so(apart, stage, old, recovery.new)
    assert apart.wait_protected(180) == recovery.new, "and it has an understudy again"


@pytest.mark.long
def test_the_robot_is_driven_on_and_gets_another_standby_when_the_standby_s_node_loses_power(
    apart: Robot, stage: Stage
) -> None:
    active = apart.wait_protected()
    (standby,) = (pod["metadata"]["name"] for pod in apart.pods() if pod["metadata"]["name"] != active)
    stage.lose(stage.node_of(standby), "down")
    lost = time.time()
    eventually(
        lambda: apart.condition("Protected").get("status") != "True",
        within=60,
        what="it is told that the understudy is lost",
        note=apart.describe,
    )
    assert apart.wait_protected(180) == active, "there is another one, on the node that is left"
    assert_undisturbed(apart, active, lost)


@pytest.mark.long
def test_without_kubelet_and_runtime_the_robot_is_driven_on_and_taken_over_when_its_application_ends(
    apart: Robot, stage: Stage
) -> None:
    old = apart.wait_protected()
    node, uid = stage.node_of(old), apart.kubectl.get("pod", old)["metadata"]["uid"]
    stage.lose(node, "stop-runtime")
    lost = time.time()
    eventually(lambda: not stage.is_ready(node), within=60, what=f"{node} is not ready", note=apart.describe)
    eventually(
        lambda: apart.kubectl.get("pod", old)["metadata"].get("deletionTimestamp"),
        within=120,
        what=f"Kubernetes gives up {old}",
        note=apart.describe,
    )
    time.sleep(5)  # nothing happens
    assert_undisturbed(apart, old, lost)
    assert apart.status()["active"] == old

    assert signal_processes(uid, APPLICATION, signal.SIGKILL)
    recovery = apart.wait_recovered(1)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", old), recovery
    assert_handed_over(apart, recovery)
    assert stage.node_of(recovery.new) != node
    assert_it_stays_so(apart, stage, old, recovery.new)
