"""Whether the pod in control is lost."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenObserver, GivenSenses
from understudy.api.kinds.failure_policy import Monitoring
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge.failure_detection import FailureDetector
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.notations import load_monitoring

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)


def detector(
    *instances: Instance, last_output: float | None = None, observer: GivenObserver | None = None
) -> FailureDetector:
    objects = ClusterObjects()
    objects.put_pods(*instances)
    objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    senses = GivenSenses(objects, observer)
    senses.observer.received_at = {"w-1": last_output} if last_output is not None else {}
    return FailureDetector(objects.pods, objects.gate, senses.agents, senses.observer)


class Evaluating(GivenObserver):
    """Evaluates a health tree over what a record has."""

    def __init__(self, tree: HealthTree, record: TopicRecord) -> None:
        super().__init__()
        self._evaluated, self._observations = tree, RecordedObservations({"/cmd_vel": record})

    def verdict(self, *, now: float, since: float) -> Verdict:
        return self._evaluated.evaluate(self._observations, now=now, since=since)


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


def test_a_clock_that_is_set_back_does_not_delay_the_detection() -> None:
    # The times of what was received are moved with the clock (ros/watching.py); the tree's grace is 30 s.
    monitoring = Monitoring.model_validate({"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}})
    tree, record = load_monitoring(monitoring), TopicRecord()
    judging = detector(observer=Evaluating(tree, record))
    before = judging.since
    tree.begin(before)
    record.add(before + 5)
    assert judging.verdict(ACTIVE, before + 5.1).state == "Healthy"
    record.shift(-3600)
    assert judging.verdict(ACTIVE, before - 3594.8).state == "Starting"
    record.add(before - 3594.7)
    assert judging.verdict(ACTIVE, before - 3594.6).state == "Healthy"
    now = before - 3594
    assert judging.verdict(ACTIVE, now).state == "Failed"
    assert judging.counts_from(now, monitoring) == now


def test_a_debounce_is_not_prolonged_by_a_clock_that_is_set_back() -> None:
    judging = detector()
    monitoring = Monitoring.model_validate(
        {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}, "debounce": "200ms"}
    )
    now = time.time()
    assert judging.counts_from(now, monitoring) == now + 0.2
    assert judging.counts_from(now - 3600, monitoring) == now - 3600 + 0.2
