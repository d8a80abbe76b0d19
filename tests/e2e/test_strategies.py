"""Each strategy, seen from the robot: who drives it, for how long nobody does, and never two at once."""

from __future__ import annotations

import time

import pytest
from understudy_demo.recovery import Recovered

from tests.e2e import handovers
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, never
from understudy.failover.strategies.steps import CLOSED_FOR

ENFORCEMENT = 0.1
"""Seconds within which one gate enforcement must be over (the enforcer's own figures are milliseconds)."""

HERTZ = 100
"""Commands per second where it matters for how long two instances command the robot."""

BUSY = 0.1
"""Seconds that a command may be late on a machine that is busy with other things."""

FAILURES = ["killed", "frozen", "deleted"]


def often(*hows: str) -> list[object]:
    """All kinds of failures, of which only these are tried each time."""
    return [how if how in hows else pytest.param(how, marks=pytest.mark.long) for how in FAILURES]


def assert_handed_over(robot: Robot, recovery: Recovered, *, expires: bool = True) -> None:
    """At the robot: nothing that the understudy sent before the switch, nothing of the failed pod after it.

    ``expires`` is whether the version that made the pods gives commands a lifespan, as 0.1.0 did not.
    """
    time.sleep(1.5)
    log = robot.log()
    decided = recovery.moments["decided"]
    handover = log.handover(recovery.old, recovery.new, switch=decided)
    print(f"\n{recovery.strategy}: {recovery.seconds:.3f} s {recovery.parts}; robot: {handover.to_json()}")
    assert handover.first_new is not None, "the understudy's commands arrive"
    never(handover.early, "commands of the understudy before the switch")
    never(expires and handover.stale, "commands that the understudy sent before the switch, and that arrived after it")
    never(
        handover.overlap > ENFORCEMENT and handover.overlap, "commands of two pods overlap by more than one enforcement"
    )
    never([c for c in log.returns() if c.received > handover.first_new + ENFORCEMENT], "the failed pod returns")
    assert recovery.seconds == pytest.approx(sum(recovery.parts.values()), abs=1e-3)


@pytest.mark.own_robot  # what the pool counts depends on which pods drove before
@pytest.mark.parametrize("how", often("frozen"))
@pytest.mark.shows(
    "leaf/topic",
    "language/yaml",
    "strategy/Fallback",
    "handover/Switch",
    "readiness/Executing",
    "output/topic",
    "gate/NetworkPolicy",
    "gate/Mux",
)
def test_an_executing_standby_takes_over(executing: Robot, how: str) -> None:
    old = executing.wait_protected()
    executing.fail(old, how)
    recovery = executing.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert recovery.old == old
    assert recovery.parts["startup"] == 0, "t_startup is 0 in full execution (the paper's finding)"
    assert_handed_over(executing, recovery)
    assert executing.wait_protected() == recovery.new, "and it is protected again"
    pool = executing.kubectl.get("fbp", "quickstart-executing")["status"]
    assert (pool["desired"], pool["replicas"], pool["ready"], pool["claimed"]) == (1, 1, 1, 1), pool


@pytest.mark.network_policy  # a mux switches at once in any case
@pytest.mark.shows("leaf/pod", "handover/BreakBeforeMake", "gate/NetworkPolicy")
def test_break_before_make_opens_the_gate_on_one_node_after_it_was_seen_closed_on_another(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    kubectl.apply(handovers.objects(robot, handover="BreakBeforeMake", hertz=HERTZ))
    old = robot.wait_protected(180)
    nodes = {pod["metadata"]["name"]: pod["spec"]["nodeName"] for pod in robot.pods()}
    robot.fail(old, "unready")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert recovery.old == old
    assert recovery.reason.startswith("condition ContainersReady of the pod is False"), recovery
    assert nodes[recovery.new] != nodes[old], nodes
    assert_handed_over(robot, recovery)
    handover = robot.log().handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    assert handover.last_old is not None
    assert handover.gap is not None
    assert handover.last_old > recovery.moments["decided"] - BUSY, "the failed instance was still sending"
    never(handover.late, "commands of the failed instance after the first one of the standby")
    # The last packet may be up to 30 ms older than the network's change, because it waits to be sent and to be read.
    assert handover.gap > CLOSED_FOR / 2, "the gate was closed for both"
    assert handover.gap < CLOSED_FOR + 2 * ENFORCEMENT + 1 / HERTZ + 3 * BUSY, "both writes and the command may be late"


@pytest.mark.parametrize("how", often("frozen"))
@pytest.mark.shows("strategy/Fallback", "readiness/Uninitialized")
def test_a_held_pod_is_claimed_started_and_takes_over(uninitialized: Robot, how: str) -> None:
    old = uninitialized.wait_protected()
    uninitialized.fail(old, how)
    recovery = uninitialized.wait_recovered(1)
    assert recovery.strategy == "Fallback/Uninitialized", recovery
    assert_handed_over(uninitialized, recovery)
    assert uninitialized.wait_protected() == recovery.new, "the pool was refilled"


@pytest.mark.parametrize("how", often("deleted"))
@pytest.mark.shows("strategy/Restart")
def test_the_pod_is_restarted(restarting: Robot, how: str) -> None:
    old = restarting.wait_protected()
    restarting.fail(old, how)
    recovery = restarting.wait_recovered(1)
    assert recovery.strategy == "Restart", recovery
    assert recovery.new != old
    assert_handed_over(restarting, recovery)
    restarting.wait_protected()


def test_a_pod_deleted_by_force_keeps_control_while_it_still_commands(executing: Robot) -> None:
    old = executing.wait_protected()
    executing.fail(old, "deleted-by-force")
    recovery = executing.wait_recovered(1)
    assert_handed_over(executing, recovery)


def test_a_thawed_pod_cannot_take_the_robot_back(executing: Robot) -> None:
    old = executing.wait_protected()
    executing.kubectl("annotate", "pod", old, "understudy.dev/test=thaw")
    executing.fail(old, "frozen")
    recovery = executing.wait_recovered(1)
    try:
        executing.signal(old, "CONT")
    except AssertionError:
        pytest.skip("the failed pod was gone before it could be thawed")
    assert_handed_over(executing, recovery)


@pytest.mark.long
def test_one_failure_after_another_is_recovered(executing: Robot) -> None:
    epoch = executing.status()["gate"]["epoch"]
    for number in (1, 2, 3):
        pod = executing.wait_protected()
        executing.fail(pod, "killed")
        recovery = executing.wait_recovered(number)
        assert recovery.epoch == epoch + number, "the epoch grows by one with every commit"
        assert_handed_over(executing, recovery)


def test_a_latched_map_reaches_the_gated_standby(executing: Robot) -> None:
    active = executing.wait_protected()
    standby = next(p["metadata"]["name"] for p in executing.pods() if p["metadata"]["name"] != active)
    said = executing.kubectl("logs", standby, "-c", "drive")
    assert "map received after" in said
    never(executing.log().of(standby), "its commands reached the robot")
