"""A robot behind a mux: only the instance in control reaches it, although no network policy keeps the others away."""

from __future__ import annotations

import signal
import time

import pytest

from tests.e2e.console import understudy
from tests.e2e.faults import Network, detour, join, signal_processes
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, never, patient
from tests.e2e.test_strategies import assert_handed_over


def muxed(kubectl: Kubectl, strategy: str, **gate: Object) -> Robot:
    """Return a robot of the quickstart with a mux, once it is protected."""
    robot = Robot(kubectl)
    kubectl.apply(patient(manifest(f"strategies/{strategy}.yaml")))
    edit = lambda item: item["spec"]["gate"].update(gate)  # noqa: E731
    kubectl.apply(robot.objects(policy=f"quickstart-{strategy}", folder="mux/", edit=edit))
    robot.wait_protected()
    return robot


def reported(robot: Robot, pod: str) -> bool:
    """Return whether the mux reports that it forwards a pod."""
    condition = robot.condition("GateEnforced")
    return condition.get("reason") == "ReportedByMux" and f"forwards {pod} and nobody else" in condition["message"]


@pytest.mark.shows("gate/Mux", "readiness/Executing")
def test_a_standby_takes_over_through_the_mux(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "executing")
    first = robot.wait_protected()
    eventually(lambda: reported(robot, first), within=30, what="the mux reports whom it forwards", note=robot.describe)
    assert len(robot.pods()) == 2, "the standby publishes all the time"
    never([c for c in robot.log().commands if c.source != first], "commands of a standby")
    policies = {item["metadata"]["name"] for item in kubectl.list("networkpolicies")}
    assert policies == {"robot-1-drive-control-plane"}, "none restricts the instances"
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert_handed_over(robot, recovery)
    eventually(
        lambda: reported(robot, recovery.new), within=30, what="the mux reports the new one", note=robot.describe
    )


@pytest.mark.shows("gate/Mux", "readiness/Uninitialized")
def test_a_held_pod_is_claimed_and_drives_through_the_mux(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "uninitialized")
    first = robot.wait_protected()
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Uninitialized", recovery
    assert_handed_over(robot, recovery)


def test_a_mux_that_restarts_goes_on_and_its_absence_is_reported(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "restart")
    active = robot.wait_driven()
    kubectl.shell(robot.robot_pod(), "mux", "kill 1")
    before = robot.log().commands[-1].received
    eventually(
        lambda: any(c.received > before + 2 for c in robot.log(tail=60).of(active)),
        within=60,
        what="it is driven again",
    )
    assert robot.status()["active"] == active
    assert robot.status().get("recoveryCount", 0) == 0, "a mux that restarts is no failure of the instance"


def test_the_mux_switches_to_the_admitted_standby_by_itself(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "executing", reflex={"deadline": "200ms"})
    active = robot.wait_protected()
    eventually(lambda: robot.condition("Reflex").get("reason") == "Armed", within=60, what="a standby is admitted")
    robot.fail(active, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing (reflex)", recovery
    handover = robot.log().handover(recovery.old, recovery.new, switch=recovery.moments["firstOutput"])
    print(f"\n{recovery.seconds:.3f} s; robot: {handover.to_json()}")
    assert handover.overlap == 0
    assert handover.gap is not None
    assert handover.gap < 0.45, "the deadline, one period of the standby, and what a busy machine needs"
    eventually(lambda: reported(robot, recovery.new), within=30, what="the switch is committed", note=robot.describe)


@pytest.mark.parametrize("together", [False, True], ids=["nodes", "node"])
def test_instances_in_the_network_of_their_node_drive_through_the_mux(kubectl: Kubectl, together: bool) -> None:
    robot = Robot(kubectl)
    first_node = kubectl.list("nodes")[0]["metadata"]["name"]
    # Pod Security allows the network of the node at this level only.
    kubectl("label", "namespace", kubectl.namespace, "pod-security.kubernetes.io/enforce=privileged")
    kubectl.apply(patient(manifest("strategies/executing.yaml")))

    def edit(item: Object) -> None:
        if together:
            item["spec"]["template"]["spec"]["nodeSelector"] = {"kubernetes.io/hostname": first_node}

    kubectl.apply(
        robot.objects(
            policy="quickstart-executing", folder="mux/", workload="host-network/robotworkload.yaml", edit=edit
        )
    )
    first = robot.wait_protected()
    # On one node, the operator may be trying whether another standby starts elsewhere.
    placed = [pod["spec"] for pod in robot.pods() if "nodeName" in pod["spec"]]
    nodes = {spec["nodeName"] for spec in placed if spec.get("hostNetwork")}
    assert len(nodes) == (1 if together else 2)
    never([c for c in robot.log().commands if c.source != first], "commands of a standby")
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert_handed_over(robot, recovery)


@pytest.mark.local_only
def test_a_network_that_enforces_no_policy_makes_no_difference(kubectl: Kubectl, network: Network) -> None:
    robot = muxed(kubectl, "executing")
    first = robot.wait_protected()
    for node in kubectl.list("nodes"):
        network.weaken(node["metadata"]["name"], "--deaf")
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert_handed_over(robot, recovery)


@pytest.mark.local_only
def test_a_standby_with_a_second_interface_to_the_robot_does_not_reach_it_but_by_the_mux(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "executing")
    first = robot.wait_protected()
    (standby,) = (pod["metadata"] for pod in robot.pods() if pod["metadata"]["name"] != first)
    itself = kubectl.get("pod", robot.robot_pod())["metadata"]
    _, cable = join(standby["uid"], itself["uid"])
    # The robot is silent while it restarts. A pause keeps the monitor from a recovery of that.
    assert understudy(kubectl, "pause", robot.workload, "--reason", "a second cable").returncode == 0
    eventually(lambda: robot.condition("Paused"), within=10, what="it is paused", note=robot.describe)
    # The agent knows the processes of its pod by what Fast DDS makes of the interfaces, so it needs the same ones.
    assert signal_processes(standby["uid"], "understudy", signal.SIGKILL)
    for words in ("understudy_quickstart.robot", "mux"):
        assert signal_processes(itself["uid"], words, signal.SIGKILL)

    def ready_again() -> bool:
        statuses = [kubectl.get("pod", pod["name"])["status"] for pod in (standby, itself)]
        have_restarted = all(one["restartCount"] for status in statuses for one in status["containerStatuses"])
        conditions = [{c["type"]: c["status"] for c in status["conditions"]} for status in statuses]
        return have_restarted and all(of_pod["Ready"] == "True" for of_pod in conditions)

    eventually(ready_again, within=60, what="standby and robot have restarted", note=robot.describe)
    eventually(lambda: robot.status()["health"] == "Healthy", within=60, what="it is well again", note=robot.describe)
    assert understudy(kubectl, "resume", robot.workload).returncode == 0
    robot.wait_protected()
    robot.wait_standby()
    at, began = cable.received, time.time()
    time.sleep(3)
    assert cable.received - at > 50, "the standby sends by its second interface too"
    assert robot.recoveries() == []
    never([c for c in robot.log().commands if c.received > began and c.source != first], "commands of the standby")
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.new) == ("Fallback/Executing", standby["name"]), recovery
    assert_handed_over(robot, recovery)


@pytest.mark.local_only
def test_an_instance_that_reaches_the_monitor_and_not_the_robot_is_replaced(kubectl: Kubectl) -> None:
    robot = muxed(kubectl, "executing")
    first = robot.wait_protected()
    robot.wait_standby()
    itself = kubectl.get("pod", robot.robot_pod())["status"]["podIP"]
    detour(kubectl.get("pod", first)["metadata"]["uid"], itself)
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", first), recovery
    assert "does not hear /cmd_vel" in recovery.reason
    assert_handed_over(robot, recovery)
