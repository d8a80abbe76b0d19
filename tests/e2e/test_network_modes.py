"""The gate on networks that enforce it badly, seen from the robot: what comes through, for how long, and what the product reports.

MODES is the table of what is expected. Each mode is that of the node of the instance that loses control; the network of the other nodes
works as it should. Each row has four events: a fence by hand, with an instance that goes on sending; a planned switchover, which deletes
the former instance; a planned switchover while the former instance's kubelet is gone, so that its pod lives on; and, again without
its kubelet, the deletion of its pod's object by force.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import pytest

from tests.e2e.console import understudy
from tests.e2e.faults import Network, Stage, staying
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Late, Robot, eventually, manifest, never, patient
from tests.e2e.test_fence import ENFORCED_WITHIN
from tests.e2e.test_strategies import assert_handed_over

pytestmark = pytest.mark.local_only

ALWAYS = math.inf
"""For as long as the mode lasts and the pod lives."""

WATCHED = 7.0
"""Seconds for which a robot is watched. The condition GateEnforced judges 3 s after the gate has changed, and once a second."""

ENDED = 1.0
"""Seconds from a planned switchover, which deletes the former pod, until the application in it has ended on a busy machine."""

LAG = 2.0


@dataclass(frozen=True)
class Mode:
    """A mode of a node's network, and what is expected of it.

    Attributes:
        options: of `scripts/cluster network`.
        fenced: seconds for which a fenced instance may still drive.
        leak: whether GateEnforced is False (NotEnforced) while the fenced instance sends.
        both: seconds for which both instances may drive after a planned switchover.
        undeleted: the same if the former pod cannot be ended. GateEnforced does not judge pods that are being deleted.
        vanished: seconds for which an active pod drives on whose object is deleted by force while it cannot be ended.
    """

    options: tuple[str, ...]
    fenced: float
    leak: bool
    both: float
    undeleted: float
    vanished: float


MODES = {
    "as it should be": Mode((), fenced=0, leak=False, both=0, undeleted=0, vanished=0),
    "established flows live on": Mode(
        ("--established",), fenced=ALWAYS, leak=True, both=ENDED, undeleted=ALWAYS, vanished=0
    ),
    "deaf": Mode(("--deaf",), fenced=ALWAYS, leak=True, both=ENDED, undeleted=ALWAYS, vanished=ALWAYS),
    "lags by 2 s": Mode(("--lag", "2000"), fenced=LAG, leak=False, both=ENDED, undeleted=LAG, vanished=LAG),
    # A fence and a switchover change policies before a pod goes.
    "vanished pods keep their policy": Mode(
        ("--keep-vanished",), fenced=0, leak=False, both=0, undeleted=0, vanished=ALWAYS
    ),
    # None of these changes labels.
    "labels lag by 5 s": Mode(("--label-lag", "5"), fenced=0, leak=False, both=0, undeleted=0, vanished=0),
}
EACH_TIME = "lags by 2 s"


def _node_of(robot: Robot, pod: str) -> str:
    node: str = robot.kubectl.get("pod", pod)["spec"]["nodeName"]
    return node


def _gate(robot: Robot) -> tuple[str, str]:
    condition = robot.condition("GateEnforced")
    return condition.get("status", ""), condition.get("reason", "")


def assert_fenced(robot: Robot, network: Network, mode: Mode) -> None:
    """A fence by hand: the fenced instance drives on for as long as the mode says, and not longer than the mode."""
    active = robot.wait_protected()
    robot.wait_standby()
    network.weaken(_node_of(robot, active), *mode.options)
    asked = time.time()
    done = understudy(robot.kubectl, "fence", robot.workload, "--reason", "a test", "--owner", "ann", "--yes")
    fenced = time.time()
    assert done.returncode == 0, done.stdout + done.stderr
    time.sleep(WATCHED)
    commands = robot.log().commands
    last = commands[-1].received
    gate = _gate(robot)
    print(f"\nfenced, and driven until {last - asked:.3f} s after the request; GateEnforced {gate}")
    never([c for c in commands if c.received > asked and c.source != active], "another instance drives a fenced robot")
    if mode.fenced == ALWAYS:
        assert last > fenced + WATCHED - 1.0, "the mode shows"
    else:
        assert last > asked + mode.fenced - ENFORCED_WITHIN, "the mode shows"
        if last > fenced + mode.fenced + ENFORCED_WITHIN:
            raise Late(f"{active} drove on until {last - fenced:.3f} s after the fence")
    assert (gate == ("False", "NotEnforced")) == mode.leak, gate
    network.restore()
    restored = time.time()
    time.sleep(2.0)
    never([c for c in robot.log().commands if c.received > restored + ENFORCED_WITHIN], "the mode has ended")
    assert understudy(robot.kubectl, "resume", robot.workload).returncode == 0
    robot.wait_protected()
    eventually(
        lambda: _gate(robot)[0] == "True", within=30, what="the gate is known to be enforced again", note=robot.describe
    )


def assert_switched(robot: Robot, network: Network, mode: Mode, both: float) -> str:
    """A planned switchover: both instances drive for as long as the mode says. Returns the pod that is active now."""
    old = robot.wait_protected()
    robot.wait_standby()
    others = {pod["metadata"]["name"] for pod in robot.pods()} - {old}
    node = _node_of(robot, old)
    assert node not in {_node_of(robot, other) for other in others}, "understudies are kept apart"
    network.weaken(node, *mode.options)
    asked = time.time()
    done = understudy(robot.kubectl, "failover", robot.workload)
    assert done.returncode == 0, done.stdout + done.stderr
    time.sleep(WATCHED)
    new: str = robot.status()["active"]
    handover = robot.log().handover(old, new, switch=asked)
    print(f"\nboth drove for {handover.overlap:.3f} s; GateEnforced {_gate(robot)}: {robot.condition('GateEnforced')}")
    assert new in others
    never(handover.early, "commands of the understudy before the switch")
    if both == ALWAYS:
        assert handover.overlap > WATCHED - 2.0, "the mode shows"
    elif handover.overlap > both + ENFORCED_WITHIN:
        raise Late(f"both drove for {handover.overlap:.3f} s")
    return new


@pytest.mark.parametrize(
    "mode", [mode if mode == EACH_TIME else pytest.param(mode, marks=pytest.mark.long) for mode in MODES]
)
def test_the_gate_in_a_mode_of_the_network(executing: Robot, network: Network, mode: str) -> None:
    assert_fenced(executing, network, MODES[mode])
    new = assert_switched(executing, network, MODES[mode], MODES[mode].both)
    network.restore()
    assert executing.wait_protected() == new


@pytest.fixture
def apart(kubectl: Kubectl, stage: Stage) -> Robot:
    """A robot whose instances are on nodes of their own."""
    robot = Robot(kubectl)
    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    objects = staying(robot.objects(policy="quickstart-executing"))
    stage.place(objects)
    kubectl.apply(objects)
    robot.wait_protected()
    return robot


def assert_it_ends(robot: Robot, stage: Stage, network: Network, old: str) -> None:
    """The former instance is silent as soon as the network works as it should, and the robot is protected in the end."""
    network.restore()
    restored = time.time()
    time.sleep(2.0)
    late = [c for c in robot.log().of(old) if c.received > restored + ENFORCED_WITHIN]
    never(late, "the former instance drives although the network works as it should again")
    stage.restore()
    assert robot.wait_protected(180) != old


@pytest.mark.long
@pytest.mark.parametrize("mode", list(MODES))
def test_a_former_instance_that_nobody_can_end_is_shut_as_far_as_the_network_does_it(
    apart: Robot, stage: Stage, network: Network, mode: str
) -> None:
    old = apart.wait_protected()
    stage.lose(stage.node_of(old), "stop-runtime")
    assert_switched(apart, network, MODES[mode], MODES[mode].undeleted)
    assert_it_ends(apart, stage, network, old)


@pytest.mark.long
@pytest.mark.parametrize("mode", list(MODES))
def test_an_active_instance_that_vanishes_from_the_api_is_shut_as_far_as_the_network_does_it(
    apart: Robot, stage: Stage, network: Network, mode: str
) -> None:
    old, expected = apart.wait_protected(), MODES[mode]
    node = stage.node_of(old)
    network.weaken(node, *expected.options)
    stage.lose(node, "stop-runtime")
    asked = time.time()
    apart.delete(old, force=True)
    deleted = time.time()
    time.sleep(WATCHED)
    log = apart.log()
    last = log.of(old)[-1].received
    status = apart.status()
    print(f"\nthe vanished pod drove until {last - asked:.3f} s after its deletion; active {status.get('active')}")
    print(f"GateEnforced {_gate(apart)}, health {status.get('health')}, {apart.recoveries()}, {log.sources()}")
    if expected.vanished == ALWAYS:
        assert last > deleted + WATCHED - 1.0, "the mode shows"
    else:
        assert last > asked + expected.vanished - ENFORCED_WITHIN, "the mode shows"
        if last > deleted + expected.vanished + ENFORCED_WITHIN:
            raise Late(f"{old} drove on until {last - deleted:.3f} s after it was deleted")
    assert_it_ends(apart, stage, network, old)


@pytest.mark.long
@pytest.mark.own_robot
def test_a_held_pod_drives_late_where_changes_of_labels_lag_and_never_beside_another(
    uninitialized: Robot, network: Network
) -> None:
    """A claim changes the labels of the pod that takes over: until they are in force, the network keeps it shut."""
    old = uninitialized.wait_protected()
    for node in uninitialized.kubectl.list("nodes"):
        network.weaken(node["metadata"]["name"], "--label-lag", "3")
    uninitialized.fail(old, "frozen")
    recovery = uninitialized.wait_recovered(1)
    assert_handed_over(uninitialized, recovery)
    first = uninitialized.log().of(recovery.new)[0].received
    print(f"the first command came {first - recovery.moments['decided']:.3f} s after the decision")
    assert recovery.strategy == "Fallback/Uninitialized", recovery
