"""A robot whose node is cut off from the cluster is driven by its instance on board, and control returns when the link is back."""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from itertools import groupby, pairwise

import pytest

from tests.e2e.faults import Stage, signal_processes
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import APPLICATION, Robot, eventually, manifest, never, patient

ON_BOARD = "on-board"
AFTER = 1.0
"""Seconds of silence after which the instance on board is forwarded (spec.gate.mux.onBoard.after of the example)."""

MUX = "mux"
"""What the command line of the process has."""

pytestmark = [pytest.mark.long, pytest.mark.local_only]


@pytest.fixture
def cut_off(kubectl: Kubectl, stage: Stage) -> Robot:
    """A robot alone on a node, with an instance on board, driven by an instance of the cluster."""
    robot = Robot(kubectl)
    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    objects = robot.objects(policy="quickstart-executing", folder="mux/on-board/")
    for item in objects:
        if item["kind"] == "Deployment":
            pod = item["spec"]["template"]["spec"]
            pod["nodeName"] = stage.nodes[-1]
            pod["tolerations"].append({"operator": "Exists", "effect": "NoSchedule"})
    kubectl.apply(objects)
    robot.wait_protected()
    return robot


def driven(robot: Robot, stage: Stage, since: float) -> tuple[list[str], float]:
    """Give the robot its link back, and wait until the mux forwards whom the gate names.

    Return who drove since a time, in order, each once per reign, and the longest time without a command since then, in seconds.
    """
    stage.restore()
    eventually(
        lambda: robot.condition("GateEnforced").get("reason") == "ReportedByMux",
        within=60,
        what="control returns",
        note=robot.describe,
    )
    time.sleep(2)
    commands = [c for c in robot.log().commands if c.received >= since]
    order = [source for source, _ in groupby(commands, key=lambda c: c.source)]
    gap = max(later.received - earlier.received for earlier, later in pairwise(commands))
    print(f"\n{order}; longest gap {gap:.3f} s")
    return order, gap


def test_a_robot_that_is_cut_off_is_driven_from_on_board_until_the_link_is_back(cut_off: Robot, stage: Stage) -> None:
    active = cut_off.status()["active"]
    cut_off.begin()
    began = time.time()
    stage.lose(stage.nodes[-1], "cut")
    time.sleep(20)
    order, gap = driven(cut_off, stage, began)
    assert order[:2] == [active, ON_BOARD], order
    assert len(order) == 3, f"one hand-over to on board, and one back: {order}"
    assert order[2] == cut_off.status()["active"]
    never([] if gap < AFTER + 0.5 else [gap], "the robot was undriven")


def test_failures_of_all_kinds_while_the_robot_is_cut_off_leave_it_with_one_driver(
    cut_off: Robot, stage: Stage, kubectl: Kubectl
) -> None:
    pod: Object = kubectl.get("pod", cut_off.robot_pod())
    uid = pod["metadata"]["uid"]
    cut_off.begin()
    active, began = cut_off.status()["active"], time.time()
    stage.lose(stage.nodes[-1], "cut")
    time.sleep(4)
    with suppress(Failed):  # without the robot's sensors it may have ended already, and its successors too
        cut_off.fail(cut_off.status()["active"], "killed")
    time.sleep(2)
    assert signal_processes(uid, APPLICATION, signal.SIGKILL), "the instance on board"
    time.sleep(10)
    assert signal_processes(uid, MUX, signal.SIGKILL)
    time.sleep(10)
    order, _ = driven(cut_off, stage, began)
    assert order == [active, ON_BOARD, cut_off.status()["active"]], "nobody drove between two commands of another one"
