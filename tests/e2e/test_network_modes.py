"""The gate on networks that enforce it badly, seen from the robot: what comes through, for how long, and what the product reports.

MODES is the table of what is expected. Each mode is that of the node of the instance that loses control; the network of the other nodes
works as it should. In each row there is a fence by hand, while the instance goes on sending, and then a planned switchover from an instance
that goes on sending until its pod is deleted.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import pytest

from tests.e2e.console import understudy
from tests.e2e.faults import Network
from tests.e2e.scenario import Late, Robot, eventually, never
from tests.e2e.test_fence import ENFORCED_WITHIN

pytestmark = pytest.mark.local_only

ALWAYS = math.inf
"""For as long as the mode lasts and the pod lives."""

WATCHED = 7.0
"""Seconds for which a fenced robot is watched. The condition GateEnforced judges 3 s after the gate has changed, and once a second."""

DELETED_WITHIN = 20.0
"""Seconds from a planned switchover until the pod of the former instance has ended."""


@dataclass(frozen=True)
class Mode:
    """A mode of a node's network, and what is expected of it.

    Attributes:
        options: of `scripts/cluster network`.
        fenced: seconds for which a fenced instance may still drive.
        leak: whether GateEnforced is False (NotEnforced) while the fenced instance sends.
        both: seconds for which both instances may drive after a planned switchover.
    """

    options: tuple[str, ...]
    fenced: float
    leak: bool
    both: float


MODES = {
    "as it should be": Mode((), fenced=0.0, leak=False, both=0.0),
    "established flows live on": Mode(("--established",), fenced=ALWAYS, leak=True, both=ALWAYS),
    "deaf": Mode(("--deaf",), fenced=ALWAYS, leak=True, both=ALWAYS),
    "lags by 600 ms": Mode(("--lag", "600"), fenced=0.6, leak=False, both=0.6),
    # Nothing vanishes here, and a fence changes no labels.
    "vanished pods keep their policy": Mode(("--keep-vanished",), fenced=0.0, leak=False, both=0.0),
    "labels lag by 5 s": Mode(("--label-lag", "5"), fenced=0.0, leak=False, both=0.0),
}
EACH_TIME = "lags by 600 ms"


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
    done = understudy(robot.kubectl, "fence", robot.workload, "--reason", "a test", "--owner", "ann", "--yes")
    fenced = time.time()
    assert done.returncode == 0, done.stdout + done.stderr
    time.sleep(WATCHED)
    late = robot.log().between(fenced, math.inf)
    seconds = late.commands[-1].received - fenced if late.commands else 0.0
    gate = _gate(robot)
    print(f"\nfenced, and drove on for {seconds:.3f} s; GateEnforced {gate}")
    never(set(late.sources()) - {active}, "another instance drives a robot that is fenced")
    if mode.fenced == ALWAYS:
        assert seconds > WATCHED - 1.0, "the mode shows"
    elif seconds > mode.fenced + ENFORCED_WITHIN:
        raise Late(f"{active} drove on for {seconds:.3f} s")
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


def assert_switched(robot: Robot, network: Network, mode: Mode) -> None:
    """A planned switchover: both instances drive for as long as the mode says, and not longer than the former pod lives."""
    old = robot.wait_protected()
    robot.wait_standby()
    others = {pod["metadata"]["name"] for pod in robot.pods()} - {old}
    node = _node_of(robot, old)
    assert node not in {_node_of(robot, other) for other in others}, "understudies are kept apart"
    network.weaken(node, *mode.options)
    asked = time.time()
    understudy(robot.kubectl, "failover", robot.workload)
    gates = set()
    while robot.has_pod(old) and time.time() < asked + 2 * DELETED_WITHIN:
        gates.add(_gate(robot))
        time.sleep(0.5)
    print(
        "gates",
        gates,
        "gone after",
        time.time() - asked,
        robot.status().get("health"),
        robot.status().get("switchover"),
    )
    time.sleep(2.0)
    new = robot.status()["active"]
    handover = robot.log().handover(old, new, switch=asked)
    print(f"both drove for {handover.overlap:.3f} s; {handover.to_json()}")
    never(handover.early, "commands of the understudy before the switch")
    if mode.both == ALWAYS:
        assert handover.overlap > 1.0, "the mode shows"
    elif handover.overlap > mode.both + ENFORCED_WITHIN:
        raise Late(f"both drove for {handover.overlap:.3f} s")
    network.restore()
    assert robot.wait_protected() == new


@pytest.mark.parametrize(
    "mode", [mode if mode == EACH_TIME else pytest.param(mode, marks=pytest.mark.long) for mode in MODES]
)
def test_the_gate_in_a_mode_of_the_network(executing: Robot, network: Network, mode: str) -> None:
    assert_fenced(executing, network, MODES[mode])
    assert_switched(executing, network, MODES[mode])
