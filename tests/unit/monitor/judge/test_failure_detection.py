"""Whether the pod in control is lost."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from tests.support.clock import set_clock
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenObserver, GivenSenses
from understudy.api.kinds.failure_policy import Monitoring
from understudy.api.protocol.agent_messages import AgentStatus, OutputCount
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge.failure_detection import KNOWN_GRACE, UNREACHED, FailureDetector
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.notations import load_monitoring

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)


def detector(
    *instances: Instance,
    last_output: float | None = None,
    observer: GivenObserver | None = None,
    driven_epoch: int | None = None,
    status: AgentStatus | None = None,
    statuses: dict[str, AgentStatus] | None = None,
) -> FailureDetector:
    objects = ClusterObjects()
    objects.put_pods(*instances)
    objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    senses = GivenSenses(objects, observer)
    senses.observer.received_at = {"w-1": last_output} if last_output is not None else {}
    senses.agents.statuses = statuses if statuses is not None else {"uid-1": status} if status is not None else {}
    return FailureDetector(objects.pods, objects.gate, senses.agents, senses.observer, driven_epoch)


class Evaluating(GivenObserver):
    """Evaluates a health tree over what a record has."""

    def __init__(self, tree: HealthTree, record: TopicRecord) -> None:
        super().__init__()
        self._evaluated, self._observations = tree, RecordedObservations({"/cmd_vel": record})

    def verdict(self, *, now: float, since: float) -> Verdict:
        return self._evaluated.evaluate(self._observations, now=now, since=since)

    def tree_begins(self, now: float) -> None:
        self._evaluated.begin(now)

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        self._evaluated.expect_samples(since=since, heard_from=heard_from)


def test_a_running_pod_that_is_evicted_from_a_lost_node_is_not_lost() -> None:
    evicted = replace(ACTIVE, terminating=True, evicted=True)
    assert detector().lost(evicted, time.time()) is None


@pytest.mark.parametrize(
    ("pod", "words"),
    [
        (replace(ACTIVE, terminating=True), "is being deleted"),
        (replace(ACTIVE, running=False), "has stopped running"),
        (None, "is gone"),
    ],
)
def test_a_pod_whose_processes_end_is_lost(pod: Instance | None, words: str) -> None:
    found = detector(last_output=time.time() - 1).lost(pod, time.time())
    assert found is not None
    failure, _ = found
    assert failure is not None
    assert failure.reason == f"pod w-1 {words}"


@pytest.mark.parametrize(("ip", "lost"), [("10.0.0.2", True), ("", False)])
def test_outputs_of_a_successor_with_the_same_name_do_not_keep_a_lost_pod_alive(ip: str, lost: bool) -> None:
    # As of a StatefulSet. While that one has no address, who is heard under the name is the process of the one before.
    successor = replace(ACTIVE, uid="uid-2", ip=ip)
    found = detector(successor, last_output=time.time()).lost(None, time.time())
    assert found is not None
    assert (found[0] is not None) == lost


def test_a_pod_without_an_object_is_lost_although_it_sends_if_an_instance_on_board_drives() -> None:
    """Control would never return from there, since its agent cannot be asked (seed 3301492)."""
    judging = detector(last_output=time.time(), observer=(observer := GivenObserver()))
    observer.received_at = {"w-1": time.time()}
    assert (found := judging.lost(None, time.time())) is not None
    assert found[0] is None
    observer.is_on_board = True
    assert (found := judging.lost(None, time.time())) is not None
    assert found[0] is not None


def test_a_clock_that_is_set_back_does_not_delay_the_detection(monkeypatch: pytest.MonkeyPatch) -> None:
    # The times of what was received are moved with the clock (ros/observe/topic_watch.py); the tree's grace is 30 s.
    monitoring = Monitoring.model_validate({"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}})
    tree, record = load_monitoring(monitoring), TopicRecord()
    judging = detector(observer=Evaluating(tree, record))
    before = judging.since
    tree.begin(before)
    record.add(before + 5)
    assert judging.verdict(ACTIVE, before + 5.1).state == "Healthy"
    set_clock(monkeypatch, -3600.0)
    record.shift(-3600)
    assert judging.verdict(ACTIVE, before - 3594.8).state == "Healthy"
    now = before - 3594
    assert judging.verdict(ACTIVE, now).state == "Failed"
    assert judging.counts_from(now, monitoring) == now


@pytest.mark.parametrize("set_after", ["", "watch", "restart"])
def test_a_clock_that_is_set_forward_does_not_end_the_startup_grace(
    monkeypatch: pytest.MonkeyPatch, set_after: str
) -> None:
    """As by NTP, while the application starts: what it has not sent yet is no failure."""
    monitoring = Monitoring.model_validate({"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}})
    tree = load_monitoring(monitoring)
    judging = detector(observer=Evaluating(tree, TopicRecord()))
    tree.begin(judging.since)
    assert judging.verdict(ACTIVE, time.time()).state == "Starting"
    set_clock(monkeypatch, 3600.0)
    if set_after:
        getattr(judging, set_after)()
    assert judging.verdict(ACTIVE, time.time() + 29).state == "Starting"
    assert judging.verdict(ACTIVE, time.time() + 31).state == "Failed"


def test_an_instance_that_had_driven_before_is_expected_as_soon_also_if_the_clock_is_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3)
    assert judging.verdict(ACTIVE, time.time()).state == "Starting"
    set_clock(monkeypatch, 3600.0)
    assert judging.verdict(ACTIVE, time.time() + 4).state == "Starting"
    assert judging.verdict(ACTIVE, time.time() + 6).state == "Failed"


def test_a_debounce_is_not_prolonged_by_a_clock_that_is_set_back() -> None:
    judging = detector()
    monitoring = Monitoring.model_validate(
        {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}, "debounce": "200ms"}
    )
    now = time.time()
    assert judging.counts_from(now, monitoring) == now + 0.2
    assert judging.counts_from(now - 3600, monitoring) == now - 3600 + 0.2


def judging_silence(
    leaf: dict[str, str],
    *,
    driven_epoch: int | None,
    discovered: bool = True,
    statuses: dict[str, AgentStatus] | None = None,
) -> tuple[FailureDetector, Evaluating]:
    """A new monitor's detector at epoch 3 of the gate, whose policy has this leaf about /cmd_vel. Nothing is received."""
    monitoring = Monitoring.model_validate({"yaml": {"topic": {"name": "/cmd_vel", **leaf}}})
    observing = Evaluating(load_monitoring(monitoring), TopicRecord())
    observing.undiscovered = set() if discovered else {"uid-1"}
    judging = detector(observer=observing, driven_epoch=driven_epoch, statuses=statuses)
    observing.tree_begins(judging.since)
    return judging, observing


@pytest.mark.parametrize(
    ("leaf", "within"),
    [
        ({"gap": "500ms"}, 5.0),
        ({"gap": "12s"}, 12.0),
        ({"rate": "> 8 Hz"}, 5.0),
        ({"rate": "> 0.1 Hz", "window": "20s"}, 20.0),
    ],
)
def test_a_silent_instance_that_had_driven_before_this_monitor_has_no_second_startup_grace(
    leaf: dict[str, str], within: float
) -> None:
    judging, _ = judging_silence(leaf, driven_epoch=3)
    start = judging.since
    assert judging.verdict(ACTIVE, start).state == "Starting"
    assert judging.verdict(ACTIVE, start + within - 0.1).state == "Starting"
    found = judging.verdict(ACTIVE, start + within + 0.1)
    assert found.state == "Failed"
    assert f"within {within:g} s" in found.reason


@pytest.mark.parametrize("driven_epoch", [None, 2])
def test_an_instance_that_the_gate_was_opened_for_since_has_the_whole_startup_grace(driven_epoch: int | None) -> None:
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=driven_epoch)
    start = judging.since
    assert judging.verdict(ACTIVE, start + 29.9).state == "Starting"
    assert judging.verdict(ACTIVE, start + 30.1).state == "Failed"


def test_a_new_monitor_that_has_not_discovered_the_instance_does_not_judge_its_silence_early() -> None:
    judging, observing = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False)
    start = judging.since
    assert judging.verdict(ACTIVE, start + 10).state == "Starting"
    observing.undiscovered.clear()
    assert judging.verdict(ACTIVE, start + 20).state == "Starting"
    assert judging.verdict(ACTIVE, start + 24.9).state == "Starting"
    assert judging.verdict(ACTIVE, start + 25.1).state == "Failed"


def test_an_instance_that_is_never_discovered_has_the_startup_grace_from_the_start_of_the_monitor() -> None:
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False)
    start = judging.since
    assert judging.verdict(ACTIVE, start + 29.9).state == "Starting"
    assert judging.verdict(ACTIVE, start + 30.1).state == "Failed"


def test_an_instance_that_is_not_discovered_and_not_ready_has_no_second_startup_grace() -> None:
    """Its node is probably lost, so nobody can discover it."""
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False)
    start, lost = judging.since, replace(ACTIVE, ready=False)
    assert judging.verdict(lost, start).state == "Starting"
    assert judging.verdict(lost, start + 4.9).state == "Starting"
    assert judging.verdict(lost, start + 5.1).state == "Failed"


def test_a_monitor_that_has_discovered_nobody_does_not_believe_that_the_instance_is_not_ready() -> None:
    """After an outage of the API server, nodes count as lost. The discovery server and this monitor were just evicted from one."""
    judging, observing = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False)
    observing.is_alone = True
    start, unready = judging.since, replace(ACTIVE, ready=False)
    assert judging.verdict(unready, start + 10).state == "Starting"
    observing.is_alone = False
    assert judging.verdict(unready, start + 20).state == "Starting"
    assert judging.verdict(unready, start + 24.9).state == "Starting"
    assert judging.verdict(unready, start + 25.1).state == "Failed"


def test_an_instance_whose_agent_answers_is_not_on_a_lost_node() -> None:
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False, statuses=statuses)
    start, unready = judging.since, replace(ACTIVE, ready=False)
    assert judging.verdict(unready, start).state == "Starting"
    assert judging.verdict(unready, start + 29.9).state == "Starting"
    assert judging.verdict(unready, start + 30.1).state == "Failed"


def test_an_instance_that_its_agent_reports_as_healthy_and_nobody_heard_has_the_startup_grace() -> None:
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, statuses=statuses)
    start = judging.since
    for after in (0.0, 4.9, 5.1, 10.3, 15.5, 29.9):
        assert judging.verdict(ACTIVE, start + after).state == "Starting"
    assert judging.verdict(ACTIVE, start + 35.2).state == "Failed"


def test_a_monitor_that_has_discovered_nobody_does_not_fail_an_instance_that_its_agent_reports_as_healthy() -> None:
    """The Service leads to no discovery server for a while. The robot and the instance have discovered each other before."""
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, observing = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False, statuses=statuses)
    observing.is_alone = True
    start = judging.since
    found = judging.verdict(ACTIVE, start + 120)
    assert (found.state, "received nothing from anybody" in found.reason) == ("Starting", True)
    observing.is_alone = False
    assert judging.verdict(ACTIVE, start + 120.2).state == "Failed", "it hears the robot and not the instance"
    observing.is_alone = True
    statuses.clear()
    assert judging.verdict(ACTIVE, start + 120.4).state == "Failed"


def test_a_monitor_that_has_received_nothing_does_not_fail_an_instance_that_its_agent_reports_as_healthy() -> None:
    """Discovery has reported the others to this monitor, and not this monitor to the others."""
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, observing = judging_silence({"gap": "500ms"}, driven_epoch=None, statuses=statuses)
    observing.hears_nobody = True
    start = judging.since
    assert judging.verdict(ACTIVE, start + 120).state == "Starting"
    observing.hears_nobody = False
    assert judging.verdict(ACTIVE, start + 120.2).state == "Failed", "it hears the robot and not the instance"


def test_a_monitor_that_never_received_a_topic_of_the_robot_does_not_fail_an_instance_whose_agent_receives_it() -> None:
    """Discovery has not reported one process of the robot to this monitor, which hears the instance."""
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, observing = judging_silence({"gap": "500ms"}, driven_epoch=None, statuses=statuses)
    observing.unheard = "/scan"
    observing.received_at["w-1"] = time.time()
    start = judging.since
    found = judging.verdict(ACTIVE, start + 120)
    assert (found.state, "received nothing on /scan" in found.reason) == ("Starting", True)
    statuses["uid-1"] = AgentStatus("Running", ready_at=time.time(), ready=False)
    assert judging.verdict(ACTIVE, start + 120.2).state == "Failed", "its agent misses something too"


def test_an_instance_whose_agent_reported_it_as_healthy_and_does_not_answer_any_more_is_judged_early() -> None:
    statuses = {"uid-1": AgentStatus("Running", ready_at=time.time() - 900, ready=True)}
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, statuses=statuses)
    start = judging.since
    for after in (0.0, 4.9, 5.1):
        assert judging.verdict(ACTIVE, start + after).state == "Starting"
    del statuses["uid-1"]
    assert judging.verdict(ACTIVE, start + 10.0).state == "Starting"
    assert judging.verdict(ACTIVE, start + 10.2).state == "Failed"


def test_an_instance_whose_agent_answers_a_moment_later_is_not_on_a_lost_node() -> None:
    """The monitor discovers the robot before it is connected to the agent."""
    statuses: dict[str, AgentStatus] = {}
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3, discovered=False, statuses=statuses)
    start, unready = judging.since, replace(ACTIVE, ready=False)
    assert judging.verdict(unready, start).state == "Starting"
    statuses["uid-1"] = AgentStatus("Running", ready_at=time.time() - 900, ready=True)
    assert judging.verdict(unready, start + 5.1).state == "Starting"
    assert judging.verdict(unready, start + 29.9).state == "Starting"
    assert judging.verdict(unready, start + 30.1).state == "Failed"


def test_an_instance_that_is_never_discovered_fails_as_soon_as_its_agent_reports_that_it_is_not_ready() -> None:
    status = AgentStatus("Running", ready_at=time.time() - 900, reason="its outputs are not healthy")
    observing = GivenObserver()
    observing.undiscovered = {"uid-1"}
    judging = detector(ACTIVE, observer=observing, driven_epoch=3, status=status)
    assert judging.verdict(ACTIVE, judging.since + KNOWN_GRACE - 0.1).state == "Starting"
    assert judging.verdict(ACTIVE, judging.since + KNOWN_GRACE + 0.1).state == "Failed"


def test_discovery_is_not_asked_for_a_healthy_instance() -> None:
    observing = GivenObserver()
    observing.undiscovered, observing.health = {"uid-1"}, Verdict("Healthy", "", "", None)
    judging = detector(ACTIVE, observer=observing, driven_epoch=3)
    judging.verdict(ACTIVE, judging.since + 1)
    assert observing.searched == []


def test_an_instance_that_takes_over_from_one_that_had_driven_has_the_whole_startup_grace() -> None:
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3)
    judging.verdict(ACTIVE, judging.since)
    judging.restart()
    assert judging.verdict(ACTIVE, judging.since + 29.9).state == "Starting"


def test_an_instance_that_another_monitor_lets_through_has_the_whole_startup_grace() -> None:
    judging, _ = judging_silence({"gap": "500ms"}, driven_epoch=3)
    start = judging.since
    assert judging.verdict(ACTIVE, start + 4).state == "Starting"
    successor = replace(ACTIVE, name="w-2", uid="uid-2")
    assert judging.verdict(successor, start + 6).state == "Starting"
    assert judging.verdict(successor, start + 29.9).state == "Starting"


@pytest.mark.parametrize(
    ("last_output", "in_the_pod", "onset"),
    [
        (None, None, 1000.0),
        (950.0, None, 950.0),
        (850.0, None, 900.0),
        (None, 960.0, 960.0),
        (970.0, 960.0, 970.0),
        (None, 1005.0, 1000.0),
    ],
)
def test_a_failure_that_an_agent_reports_begins_with_the_last_sign_of_health(
    last_output: float | None, in_the_pod: float | None, onset: float
) -> None:
    """Else state is restored from before the instance drove: after a recovery that was given up, only later messages count, and a new
    monitor has heard none."""
    now = time.time()
    shift = now - 1000.0
    outputs = {"/cmd_vel": OutputCount(7, in_the_pod + shift if in_the_pod is not None else None)}
    status = AgentStatus("Running", ready_at=900.0 + shift, reason="its outputs are not healthy", outputs=outputs)
    judging = detector(ACTIVE, last_output=last_output + shift if last_output is not None else None, status=status)
    judging.restart(now - 2 * KNOWN_GRACE)
    found = judging.verdict(ACTIVE, now).onset
    assert found is not None
    assert found - shift == pytest.approx(onset, abs=0.01)


@pytest.mark.parametrize(("was_heard", "within"), [(False, 3.0), (True, 1.0)])
def test_an_instance_that_its_agent_reports_has_less_time_to_be_heard_if_it_was_heard_before(
    was_heard: bool, within: float
) -> None:
    """As after somebody deleted the gate: the instance may have failed while it was missing."""
    now = time.time()
    status = AgentStatus("Running", ready_at=now - 60, reason="no /cmd_vel for 1 s")
    judging = detector(ACTIVE, last_output=now - 2.0 if was_heard else None, status=status)
    judging.watch()
    start = judging.since
    assert judging.verdict(ACTIVE, start + within - 0.1).state == "Starting"
    assert judging.verdict(ACTIVE, start + within + 0.1).state == "Failed"


def test_an_instance_that_the_mux_at_the_robot_does_not_hear_has_failed_although_this_monitor_receives_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monitoring = Monitoring.model_validate({"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}})
    tree, record = load_monitoring(monitoring), TopicRecord()
    observer = Evaluating(tree, record)
    judging = detector(observer=observer)
    begun = judging.since
    tree.begin(begun)

    def state_after(seconds: float) -> str:
        monkeypatch.setattr(CLOCK, "now", lambda: CLOCK.of_system(begun + seconds))
        record.add(begun + seconds)
        return judging.verdict(ACTIVE, begun + seconds + 0.1).state

    observer.missed = "/cmd_vel"
    assert state_after(1.0) == state_after(UNREACHED + 0.9) == "Healthy", "a mux that starts again learns of it"
    assert state_after(UNREACHED + 1.1) == "Failed"
    assert judging.verdict(ACTIVE, begun + UNREACHED + 1.2).reason.startswith(
        "the mux at the robot does not hear /cmd_vel of w-1"
    )
    observer.missed = ""
    assert state_after(UNREACHED + 1.3) == "Healthy"
    observer.missed = "/cmd_vel"
    assert state_after(UNREACHED + 2.0) == "Healthy", "it counts from then on"
