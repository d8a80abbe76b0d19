"""The gate on networks that enforce it badly, seen from the robot: what comes through, for how long, and what the product reports.

MODES is the table of what is expected. Each mode is that of the node of the instance that loses control; the network of the other nodes
works as it should. Each row has four events: a fence by hand, with an instance that goes on sending; a planned switchover, which deletes
the former instance; a planned switchover while the former instance's kubelet is gone, so that its pod lives on; and, again without
its kubelet, the deletion of its pod's object by force.

The tests of labels run on Cilium too, which applies changes of labels late by itself.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass

import pytest

from tests.e2e.console import understudy
from tests.e2e.faults import Network, Stage, has_network_modes
from tests.e2e.kubectl import Failed, Kubectl
from tests.e2e.scenario import Late, Robot, eventually, never
from tests.e2e.test_fence import ENFORCED_WITHIN
from tests.e2e.test_strategies import ENFORCEMENT, assert_handed_over

LABEL_LAG = 10.0
"""Lag of changes of labels, in seconds, on the provider's own network: longer than a standby has to take over."""

CILIUM_LABEL_LAG = (6.0, 35.0)
"""Shortest and longest lag of changes of labels on Cilium with its default settings, in seconds."""

pytestmark = [
    pytest.mark.local_only,
    pytest.mark.network_policy,
    pytest.mark.long,  # CI has each mode by packets: tests/cluster/test_network_modes.py
]

ALWAYS = math.inf
"""For as long as the mode lasts and the pod lives."""

WATCHED = 7.0
"""Seconds for which a robot is watched."""

ENDED = 1.0
"""Seconds from a planned switchover, which deletes the former pod, until the application in it has ended on a busy machine."""

LAG = 0.6
"""Seconds that SoleDriver allows a network to enforce a change."""

LEAK = 5.0
"""Seconds within which a leak has been noticed (after 1 s) and ended, on a busy machine: by the deletion of its pod if that can be
ended, otherwise by a gate that is closed for the other instance too.
"""


@dataclass(frozen=True)
class Mode:
    """A mode of a node's network, and what is expected of it.

    Attributes:
        options: of `scripts/cluster network`.
        fenced: seconds for which a fenced instance may still drive. Its pod is not deleted, because a fence pauses the workload.
        both: seconds for which both instances may drive after a planned switchover.
        undeleted: the same if the former pod cannot be ended.
        vanished: seconds for which an active pod drives on whose object is deleted by force while it cannot be ended. While it does, nobody
            else drives.
        leak: whether the fenced and the undeleted instance are reported: SoleDriver is False.
    """

    options: tuple[str, ...]
    fenced: float
    both: float
    undeleted: float
    vanished: float
    leak: bool


MODES = {
    "as it should be": Mode((), fenced=0, both=0, undeleted=0, vanished=0, leak=False),
    "established flows live on": Mode(
        ("--established",), fenced=ALWAYS, both=ENDED, undeleted=LEAK, vanished=0, leak=True
    ),
    "deaf": Mode(("--deaf",), fenced=ALWAYS, both=ENDED, undeleted=LEAK, vanished=ALWAYS, leak=True),
    "lags by 600 ms": Mode(("--lag", "600"), fenced=LAG, both=LAG, undeleted=LAG, vanished=LAG, leak=False),
    # A fence and a switchover change policies before a pod goes.
    "vanished pods keep their policy": Mode(
        ("--keep-vanished",), fenced=0, both=0, undeleted=0, vanished=ALWAYS, leak=False
    ),
    # None of these changes labels.
    "labels lag by 5 s": Mode(("--label-lag", "5"), fenced=0, both=0, undeleted=0, vanished=0, leak=False),
}


def _node_of(robot: Robot, pod: str) -> str:
    node: str = robot.kubectl.get("pod", pod)["spec"]["nodeName"]
    return node


def _sole_driver(robot: Robot) -> tuple[str, str]:
    condition = robot.condition("SoleDriver")
    return condition.get("status", ""), condition.get("reason", "")


def _watched(robot: Robot) -> set[tuple[str, str]]:
    """Watch the robot for a while. Returns what was reported of its drivers."""
    begun, found = time.time(), set()
    while time.time() < begun + WATCHED:
        found.add(_sole_driver(robot))
        time.sleep(0.5)
    return found


def assert_reported(found: set[tuple[str, str]], leak: bool) -> None:
    """A leak was reported of the drivers at some time, or never."""
    assert ("False" in {status for status, _ in found}) == leak, found


def assert_fenced(robot: Robot, network: Network, mode: Mode) -> None:
    """A fence by hand: the fenced instance drives on for as long as the mode says."""
    active = robot.wait_protected()
    robot.wait_standby()
    network.weaken(_node_of(robot, active), *mode.options)
    asked = time.time()
    done = understudy(robot.kubectl, "fence", robot.workload, "--reason", "a test", "--owner", "ann", "--yes")
    fenced = time.time()
    assert done.returncode == 0, done.stdout + done.stderr
    found = _watched(robot)
    commands = robot.log().commands
    last = commands[-1].received
    print(f"\ndriven until {last - asked:.3f} s after the request for a fence, {last - fenced:.3f} s after it; {found}")
    never([c for c in commands if c.received > asked and c.source != active], "another instance drives a fenced robot")
    if last > fenced + mode.fenced + ENFORCED_WITHIN:
        raise Late(f"{active} drove on until {last - fenced:.3f} s after the fence")
    assert_reported(found, mode.leak)
    network.restore()
    assert understudy(robot.kubectl, "resume", robot.workload).returncode == 0
    robot.wait_protected()
    eventually(
        lambda: _sole_driver(robot)[0] == "True", within=30, what="a sole driver is reported", note=robot.describe
    )


def assert_switched(robot: Robot, network: Network, mode: Mode, *, is_undeleted: bool = False) -> None:
    """A planned switchover: both instances drive for as long as the mode says."""
    old = robot.wait_protected()
    robot.wait_standby()
    others = {pod["metadata"]["name"] for pod in robot.pods()} - {old}
    node = _node_of(robot, old)
    assert node not in {_node_of(robot, other) for other in others}, "understudies are kept apart"
    network.weaken(node, *mode.options)
    asked = time.time()
    understudy(robot.kubectl, "failover", robot.workload, "--yes")
    found = _watched(robot)
    log = robot.log().between(asked, math.inf)
    theirs, ours = log.of(old), [c for c in log.commands if c.source in others]
    assert ours, robot.describe()
    both = min(theirs[-1].received, ours[-1].received) - ours[0].received
    print(f"\nboth drove for {both:.3f} s; {found}")
    if both > (mode.undeleted if is_undeleted else mode.both) + ENFORCED_WITHIN:
        raise Late(f"both drove for {both:.3f} s")
    assert_reported(found, mode.leak and is_undeleted)


@pytest.mark.parametrize("mode", list(MODES))
@pytest.mark.shows("gate/NetworkPolicy")
def test_the_gate_in_a_mode_of_the_network(executing: Robot, network: Network, mode: str) -> None:
    assert_fenced(executing, network, MODES[mode])
    assert_switched(executing, network, MODES[mode])
    network.restore()
    executing.wait_protected()


def assert_it_ends(robot: Robot, stage: Stage, network: Network, old: str) -> None:
    """The former instance is silent as soon as the network works as it should, and the robot is protected in the end."""
    network.restore()
    restored = time.time()
    time.sleep(2.0)
    late = [c for c in robot.log().of(old) if c.received > restored + ENFORCED_WITHIN]
    never(late, "the former instance drives although the network works as it should again")
    stage.restore()
    assert robot.wait_protected(180) != old


@pytest.mark.parametrize("mode", list(MODES))
def test_a_former_instance_that_nobody_can_end_is_shut_as_far_as_the_network_does_it(
    apart: Robot, stage: Stage, network: Network, mode: str
) -> None:
    old = apart.wait_protected()
    stage.lose(stage.node_of(old), "stop-runtime")
    assert_switched(apart, network, MODES[mode], is_undeleted=True)
    assert_it_ends(apart, stage, network, old)


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
    found = _watched(apart)
    log = apart.log()
    last = log.of(old)[-1].received
    status = apart.status()
    print(
        f"\nthe vanished pod drove until {last - asked:.3f} s after its deletion; active {status.get('active')}; {found}"
    )
    if expected.vanished == ALWAYS:
        assert last > deleted + WATCHED - 1.0, "the mode shows"
        never(set(log.sources()) - {old}, "another instance drives beside the vanished one")
    else:
        assert last > asked + expected.vanished - ENFORCED_WITHIN, "the mode shows"
        if last > deleted + expected.vanished + ENFORCED_WITHIN:
            raise Late(f"{old} drove on until {last - deleted:.3f} s after it was deleted")
    assert_reported(found, leak=False)
    assert_it_ends(apart, stage, network, old)


@pytest.fixture
def label_lag(request: pytest.FixtureRequest, kubectl: Kubectl) -> float:
    """Have a network that applies changes of labels late. Returns the longest time, in seconds."""
    if has_network_modes():
        network: Network = request.getfixturevalue("network")
        for node in kubectl.list("nodes"):
            network.weaken(node["metadata"]["name"], "--label-lag", f"{LABEL_LAG:g}")
        return LABEL_LAG
    try:
        kubectl.list("ciliumidentities")
    except Failed:
        pytest.skip("the network applies changes of labels at once")
    return CILIUM_LABEL_LAG[1]


@pytest.mark.alone
def test_a_claim_changes_no_label_that_a_network_applies_late(uninitialized: Robot, label_lag: float) -> None:
    old = uninitialized.wait_protected()
    uninitialized.fail(old, "frozen")
    recovery = uninitialized.wait_recovered(1)
    assert_handed_over(uninitialized, recovery)
    assert recovery.strategy == "Fallback/Uninitialized", recovery
    first = uninitialized.log().of(recovery.new)[0].received
    print(f"the first command came {first - recovery.moments['decided']:.3f} s after the decision")
    if first > recovery.moments["decided"] + CILIUM_LABEL_LAG[0]:
        raise Late(f"the first command came {first - recovery.moments['decided']:.3f} s after the decision")


@pytest.mark.alone
def test_the_robot_is_driven_again_though_the_standby_s_labels_have_just_changed(
    executing: Robot, label_lag: float
) -> None:
    """The network applies no policy to the standby, so the switch to it is lost, and the next strategy follows."""
    robot = executing
    old = robot.wait_protected()
    robot.wait_standby()
    standby = next(name for pod in robot.pods() if (name := pod["metadata"]["name"]) != old)
    robot.kubectl("label", "pod", standby, "example.com/note=unrelated")
    labelled = time.time()
    robot.fail(old, "frozen")
    recovery = robot.wait_recovered(1, within=label_lag + 60.0)
    assert recovery.old == old, recovery
    assert_handed_over(robot, recovery)
    time.sleep(max(0.0, labelled + label_lag + 2.0 - time.time()))  # the policies that it missed are applied at once
    reigns = robot.log().reigns()
    print(f"failed {recovery.moments['detected'] - labelled:.3f} s after the change of labels; {recovery.attempts}")
    print([(one.source, one.first - labelled, one.last - labelled) for one in reigns])
    together = [(a, b) for a, b in itertools.pairwise(reigns) if a.last > b.first + ENFORCEMENT]
    never(together, "two instances drive")
    if recovery.new == standby:  # the network had already read its labels
        assert recovery.strategy == "Fallback/Executing", recovery
    else:
        assert recovery.strategy == "Restart", recovery
        tried = [(one["strategy"], one["result"]) for one in recovery.attempts if one.get("pod") == standby]
        assert tried == [("Fallback/Executing", "NotVerified")], recovery
        told = [one for one in robot.kubectl.list("events") if one["reason"] == "StrategyNotVerified"]
        assert any(standby in one["message"] for one in told), told
    robot.wait_protected()
