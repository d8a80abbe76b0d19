"""A robot whose node is cut off from the cluster is driven by its instance on board, and control returns when the link is back."""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from itertools import groupby, pairwise

import pytest

from tests.e2e.faults import Stage, signal_processes
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.navigation import Navigator
from tests.e2e.scenario import APPLICATION, Robot, eventually, manifest, never, patient

ON_BOARD = "on-board"
AFTER = 1.0
"""Seconds of silence after which the instance on board is forwarded (spec.gate.mux.onBoard.after of the example)."""

CUT = 600.0
"""Seconds for which the robot with a goal is cut off."""

DONE = 300.0
"""Seconds for the rest of the goal, on a machine that is busy."""

MUX = "mux"
"""What the command line of the process has."""

pytestmark = [pytest.mark.long, pytest.mark.local_only]


class OnBoardNavigator(Navigator):
    """A mobile robot with an instance of its navigation stack on board."""

    FOLDER = "on-board"


@pytest.fixture
def cut_off(kubectl: Kubectl, stage: Stage) -> Robot:
    """A robot alone on a node, with an instance on board, driven by an instance of the cluster."""
    robot = Robot(kubectl)
    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    objects = robot.objects(policy="quickstart-executing", folder="mux/on-board/")
    place(objects, stage)
    kubectl.apply(objects)
    robot.wait_protected()
    return robot


def place(objects: list[Object], stage: Stage) -> None:
    """Have the robot among the objects run alone on a node."""
    for item in objects:
        if item["kind"] == "Deployment":
            pod = item["spec"]["template"]["spec"]
            pod["nodeName"] = stage.nodes[-1]
            pod["tolerations"].append({"operator": "Exists", "effect": "NoSchedule"})


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


@pytest.mark.alone  # a stack of five processes needs most of the machine
@pytest.mark.timeout(1800)
def test_a_goal_is_resumed_after_a_cut_of_ten_minutes_with_three_failures(kubectl: Kubectl, stage: Stage) -> None:
    navigator = OnBoardNavigator(kubectl)
    navigator.set_up("executing", edit=lambda objects: place(objects, stage))
    active = navigator.wait_protected()
    navigator.send_client(1, within=CUT + 2 * DONE)
    navigator.wait_driving(120)
    pod = kubectl.get("pod", navigator.robot_pod())
    began = time.time()
    stage.lose(stage.nodes[-1], "cut")
    for fail in (
        lambda: navigator.delete(active, force=True),
        lambda: signal_processes(pod["metadata"]["uid"], "standstill", signal.SIGKILL),
        lambda: signal_processes(pod["metadata"]["uid"], MUX, signal.SIGKILL),
    ):
        time.sleep(CUT / 4)
        fail()
    time.sleep(max(0.0, began + CUT - time.time()))
    ended = time.time()
    assert navigator.tour().goals[0].status == "", "the goal has not ended"
    stage.restore()
    tour = navigator.wait_done(DONE)
    log = navigator.log()
    cut = [c for c in log.commands if began + 2 * AFTER <= c.received <= ended]
    gaps = sorted((b.received - a.received for a, b in pairwise(cut)), reverse=True)
    print(f"\n{len(cut)} commands while it was cut off, the longest gaps: {[round(gap, 2) for gap in gaps[:4]]}")
    never([c for c in cut if c.linear or c.angular], "commands of the cluster while the link was down")
    never([m for m in log.motions if began + 4 * AFTER <= m.time <= ended and abs(m.speed) > 0.01], "it moved")
    assert len(gaps) > CUT, "its instance on board has it in hand"
    (goal,) = tour.goals
    assert (goal.status, goal.asked) == ("succeeded", 1)
