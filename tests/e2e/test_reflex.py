"""The reflex, seen from the robot: its own reader falls over to the standby, and the loser never comes back."""

from __future__ import annotations

import signal
import time
from itertools import groupby

import pytest
from understudy_demo.recovery import Recovered

from tests.e2e.faults import ApiServer, Stage, cluster, has_network_modes, process_states, signal_processes, staying
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import APPLICATION, Late, Robot, eventually, manifest, never
from tests.e2e.test_strategies import ENFORCEMENT

DEADLINE = 0.25
"""Seconds of silence after which the robot's reader takes the standby's commands. Long for commands every 50 ms, since on a
machine that is busy with other things the pod in control is late at times, and being late is what the reflex is for.
"""

TIMEOUT = 0.5
"""Seconds of silence after which the quickstart's policy calls it a failure: the reflex is there long before."""

STRATEGY = "Fallback/Executing (reflex)"

IN_FLIGHT = 5.0
"""Seconds for which a node that can't reach its neighbours keeps packets for them (three ARP requests, a second each) and
some more: what was sent just before its cable was pulled may arrive when it is put back sooner."""

LATE = 90.0
"""Seconds that an engine such as Cilium takes at most until it follows, after an outage of the API server: it asks again after
pauses that double."""

PROCESS = f"python3 -m {APPLICATION}"
"""How the application's process begins, and the script that holds it doesn't."""


def with_reflex(workload: Object) -> None:
    workload["spec"]["gate"] = {"reflex": {"deadline": f"{DEADLINE * 1000:.0f}ms"}}


@pytest.fixture
def reflexive(kubectl: Kubectl, gate_kind: str) -> Robot:
    """A robot whose reader, or whose mux, falls over to an executing standby by itself."""
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(manifest("strategies/executing.yaml"))
    kubectl.apply(staying(robot.objects(policy="quickstart-executing", edit=with_reflex)))
    robot.wait_protected()
    return robot


@pytest.fixture
def apart(kubectl: Kubectl, stage: Stage) -> Robot:
    """The same, its instances on two nodes where nothing else is."""
    robot = Robot(kubectl)
    kubectl.apply(manifest("strategies/executing.yaml"))
    objects = staying(robot.objects(policy="quickstart-executing", edit=with_reflex))
    stage.place(objects)
    kubectl.apply(objects)
    wait_armed(robot)
    assert len({stage.node_of(name) for name in instances(robot)}) == 2, "understudies are kept apart"
    return robot


def wait_armed(robot: Robot, within: float = 120.0) -> str:
    """Wait until a standby is let through beside the pod in control; that pod."""
    robot.wait_protected(within)
    eventually(
        lambda: robot.condition("Reflex").get("status") == "True",
        within=within,
        what="a standby is let through",
        note=robot.describe,
    )
    active: str = robot.status()["active"]
    return active


def recovered(robot: Robot, old: str) -> Recovered:
    """The first recovery, of the failure that was made; on a busy machine the pod may have been late before that."""
    recovery = robot.wait_recovered(1)
    if recovery.old != old or recovery.strategy != STRATEGY:
        raise Late(f"{old} was to fail and its standby to take over by the reflex; it came to {recovery}")
    return recovery


def assert_fell_over(robot: Robot, recovery: Recovered, *, failed: float, returned: bool = False) -> None:
    """At the robot: the standby came well before anybody's timeout, and nothing of the loser after the commit.

    ``failed`` is when it was made to fail: on a busy machine it may have been late before, and have come back from that.
    """
    time.sleep(1.5)
    log = robot.log()
    handover = log.handover(recovery.old, recovery.new, switch=recovery.moments["lastHealthy"])
    print(f"\n{recovery.strategy}: {recovery.seconds:.3f} s; robot: {handover.to_json()}")
    assert recovery.parts["cluster"] == recovery.parts["startup"] == recovery.parts["reinitialization"] == 0
    assert recovery.seconds == pytest.approx(recovery.parts["detection"], abs=1e-3)
    assert handover.first_new is not None, "the standby's commands arrive"
    fenced = recovery.moments["fenced"]
    after = [c for c in log.of(recovery.old) if c.received > fenced + ENFORCEMENT]
    never(after, f"commands of {recovery.old} after it was fenced")
    if not returned:
        back = [c for c in log.returns() if c.source == recovery.old and c.sent > failed]
        never(back, f"control moved, and came back to {recovery.old}")
    if handover.gap is None or handover.gap > TIMEOUT:
        raise Late(f"the robot had no command for {handover.gap} s, the reflex should have been there")


def assert_drives_alone_until_the_network_follows(robot: Robot, old: str, back: float) -> None:
    """After an outage, an engine that watches the API server by itself follows late: until then nobody else is let through.

    ``back`` is when the API server was started again, after the failed pod thawed. The recovery ends as failed, since that pod still
    drives, or as recovered, if the network was quicker.
    """

    def replaced() -> bool:
        active = robot.status().get("active")
        return active not in (None, old) and robot.log().commands[-1].source == active

    eventually(replaced, within=LATE, what=f"another instance than {old} drives", note=robot.describe)
    [*_, first] = [entry for entry in robot.recoveries() if entry.old == old]
    log = robot.log()
    last = max(c.received for c in log.of(old))
    print(f"\n{first.result}: the network followed {last - back:.1f} s after the API server was back")
    during = [c for c in log.commands if c.received > first.moments["fenced"]]
    drivers = [source for source, _ in groupby(c.source for c in during)]
    never(old in drivers[1:], f"{old} drove again after another instance: {drivers}")
    assert set(drivers) <= {old, robot.status()["active"]}, drivers


@pytest.mark.long
@pytest.mark.alone  # its readers go to another instance after 100 ms
@pytest.mark.parametrize("how", ["killed", "frozen"])
def test_the_robots_reader_falls_over_by_itself_and_the_loser_is_fenced(reflexive: Robot, how: str) -> None:
    old = wait_armed(reflexive)
    reflexive.fail(old, how)
    # Not before: the command takes a second on a busy machine, in which the reader may leave and come back.
    failed = time.time()
    recovery = recovered(reflexive, old)
    assert recovery.epoch == 2
    if how == "frozen":
        try:
            reflexive.signal(old, "CONT")
        except Failed:
            print("it was gone before it could be thawed")
    assert_fell_over(reflexive, recovery, failed=failed)
    eventually(lambda: not reflexive.has_pod(old), within=60, what=f"the failed pod {old} is gone")
    assert wait_armed(reflexive) == recovery.new, "and the next standby is let through"


@pytest.mark.local_only
@pytest.mark.parametrize("how", [pytest.param("killed", marks=pytest.mark.long), "frozen"])
def test_the_reflex_works_without_the_api_server_and_is_committed_once_it_is_back(
    reflexive: Robot, api_server: ApiServer, how: str
) -> None:
    old = wait_armed(reflexive)
    uid = reflexive.kubectl.get("pod", old)["metadata"]["uid"]
    api_server.stop()
    failed = time.time()
    assert signal_processes(uid, APPLICATION, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
    time.sleep(8)  # also for the kubelet, which starts a killed application again by itself
    back = time.time()
    api_server.start()
    recovery = recovered(reflexive, old)
    assert recovery.moments["detected"] < back < recovery.moments["fenced"], "committed when it could be"
    assert_fell_over(reflexive, recovery, failed=failed)
    alone = reflexive.log().between(failed + TIMEOUT, back)
    assert set(alone.sources()) == {recovery.new}, "driven by the standby alone, with no API server at all"
    eventually(lambda: not reflexive.has_pod(old), within=60, what=f"the failed pod {old} is gone")


@pytest.mark.network_policy  # a mux does not go back to the pod that thaws
@pytest.mark.long
@pytest.mark.local_only
def test_a_pod_that_thaws_while_there_is_no_api_server_drives_until_the_commit_and_never_after(
    reflexive: Robot, api_server: ApiServer
) -> None:
    old = wait_armed(reflexive)
    uid = reflexive.kubectl.get("pod", old)["metadata"]["uid"]
    api_server.stop()
    failed = time.time()
    assert signal_processes(uid, APPLICATION, signal.SIGSTOP)
    time.sleep(3)
    assert signal_processes(uid, APPLICATION, signal.SIGCONT)
    time.sleep(2)
    back = time.time()
    api_server.start()
    if not has_network_modes():
        assert_drives_alone_until_the_network_follows(reflexive, old, back)
        return
    recovery = recovered(reflexive, old)
    assert_fell_over(reflexive, recovery, failed=failed, returned=True)


def instances(robot: Robot) -> dict[str, str]:
    """UIDs of the pods that aren't being deleted, by name."""
    return {
        pod["metadata"]["name"]: pod["metadata"]["uid"]
        for pod in robot.pods()
        if not pod["metadata"].get("deletionTimestamp")
    }


def wait_held(uid: str) -> None:
    """Wait until the application of a pod is stopped."""

    def stopped() -> bool:
        found = process_states(uid, PROCESS)
        return bool(found) and set(found.values()) == {"T"}

    eventually(stopped, within=30, every=0.05, what="the application is held")


@pytest.mark.long
@pytest.mark.local_only
def test_a_pod_whose_node_was_cut_off_is_held_and_never_drives_again(apart: Robot, stage: Stage) -> None:
    old = wait_armed(apart)
    uid, node = instances(apart)[old], stage.node_of(old)
    stage.lose(node, "cut")
    cut = time.time()
    wait_held(uid)
    recovery = recovered(apart, old)
    assert set(process_states(uid, PROCESS).values()) == {"T"}
    time.sleep(max(0.0, cut + IN_FLIGHT - time.time()))
    stage.restore()
    eventually(lambda: not apart.has_pod(old), within=120, what=f"the failed pod {old} is gone")
    assert_fell_over(apart, recovery, failed=cut)
    assert apart.log().commands[-1].source == recovery.new


@pytest.mark.long
@pytest.mark.local_only
def test_the_same_without_the_api_server_until_the_node_is_back(
    apart: Robot, stage: Stage, api_server: ApiServer
) -> None:
    old = wait_armed(apart)
    uid, node = instances(apart)[old], stage.node_of(old)
    api_server.stop()
    stage.lose(node, "cut")
    cut = time.time()
    wait_held(uid)
    time.sleep(3)
    cluster("node", "connect", node)
    time.sleep(4)  # the monitor is there, and it knows that another one drives
    assert set(process_states(uid, PROCESS).values()) == {"T"}
    api_server.start()
    recovery = recovered(apart, old)
    stage.restore()
    eventually(lambda: not apart.has_pod(old), within=120, what=f"the failed pod {old} is gone")
    assert_fell_over(apart, recovery, failed=cut)


@pytest.mark.long
@pytest.mark.local_only
def test_a_standby_continues_after_a_network_cut_and_a_missing_monitor_holds_no_instance(
    apart: Robot, stage: Stage
) -> None:
    active = wait_armed(apart)
    pods = instances(apart)
    standby = next(name for name in pods if name != active)
    before = process_states(pods[standby], PROCESS)
    stage.lose(stage.node_of(standby), "cut")
    wait_held(pods[standby])
    stage.restore()

    def goes_on() -> bool:
        states = process_states(pods[standby], PROCESS)
        return bool(states) and "T" not in states.values()

    eventually(goes_on, within=60, what="it goes on", note=apart.describe)
    assert set(process_states(pods[standby], PROCESS)) == set(before), "as the same processes"
    assert wait_armed(apart) == active
    told = [event for event in apart.kubectl.list("events", "") if event["reason"] == "InstanceCutOff"]
    assert any(standby in event["message"] and "it runs again" in event["message"] for event in told), told
    apart.replace_monitor()
    for _ in range(20):
        for name, uid in pods.items():
            assert "T" not in process_states(uid, PROCESS).values(), (
                f"{name} is held although only the monitor was gone"
            )
        time.sleep(0.1)
    assert not apart.recoveries()


def test_a_reflex_with_several_outputs_is_refused_unless_all_are_accepted(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    kubectl.apply(manifest("strategies/executing.yaml"))

    def several(workload: Object) -> None:
        with_reflex(workload)
        workload["spec"]["outputs"].append({"topic": "/lamp", "type": "std_msgs/msg/Bool"})

    objects = robot.objects(policy="quickstart-executing", edit=several)
    kubectl.apply(objects)
    eventually(
        lambda: robot.condition("Accepted").get("reason") == "ReflexUnsafe", within=30, what="the reflex is refused"
    )
    message = robot.condition("Accepted")["message"]
    assert "spec.gate.reflex.accept (missing: /cmd_vel, /lamp)" in message
    workload = next(item for item in objects if item["kind"] == "RobotWorkload")
    workload["spec"]["gate"]["reflex"]["accept"] = ["/cmd_vel", "/lamp"]
    kubectl.apply([workload])
    eventually(lambda: robot.condition("Accepted").get("status") == "True", within=30, what="it is accepted by name")
    workload["spec"]["gate"]["reflex"]["deadline"] = "200ms"
    with pytest.raises(Failed, match="cannot be changed"):
        kubectl.apply([workload])
