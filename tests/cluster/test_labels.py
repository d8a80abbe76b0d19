"""Labels of instances that somebody changed although the admission policy was not there are restored."""

from __future__ import annotations

import time

import pytest

from tests.cluster.operators import CORE, Fleet, Operator, hot, policy, workload
from tests.cluster.test_pool_pods import claimed_from_a_pool
from tests.support.cluster import Object, until
from understudy.api import names


def _labels(fleet: Fleet, pod: Object) -> dict[str, str]:
    found: dict[str, str] = fleet.get("Pod", pod["metadata"]["name"], CORE)["metadata"].get("labels") or {}
    return found


def _own(fleet: Fleet) -> list[Object]:
    return [pod for pod in fleet.instances() if names.SOURCE in pod["metadata"]["labels"]]


REPAIRED_WITHIN = 1.0
"""Seconds. The operator waits 0.2 s for further changes. The rest is for the event, a patch and this test's requests, each of which takes
some ten milliseconds at most if no other test runs beside it."""


@pytest.mark.alone
def test_the_labels_of_a_standby_are_restored_within_a_second(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot"), hot(), workload())
    until(lambda: len(fleet.instances()) == 2, "an active pod and a standby")
    standby = next(pod for pod in fleet.instances() if names.POOL in pod["metadata"]["labels"])
    own = until(lambda: [pod for pod in _own(fleet) if names.INSTANCE in pod["metadata"]["labels"]], "labels")[0]
    before, took = _labels(fleet, standby), []
    for change in (
        {names.INSTANCE: own["metadata"]["name"]},
        {names.POOL: None},
        {names.WORKLOAD: None},
        {names.WORKLOAD: None, names.COMPONENT: None, names.INSTANCE: None, names.POOL: None},
    ):
        fleet.cluster.patch(standby, {"metadata": {"labels": change}})
        began = time.monotonic()
        until(
            lambda: _labels(fleet, standby) == before, f"labels to be restored after {change}", seconds=10, every=0.02
        )
        took.append(time.monotonic() - began)
    assert max(took) < REPAIRED_WITHIN, took


def test_the_pool_of_a_claimed_pod_is_restored(fleet: Fleet, operator: Operator) -> None:
    """Without it, its monitor would not know the token of its agent."""
    claimed = claimed_from_a_pool(fleet, replicas=1)
    fleet.cluster.patch(claimed, {"metadata": {"labels": {names.POOL: None}}})
    until(lambda: _labels(fleet, claimed).get(names.POOL) == "spare", "the label to be restored", seconds=10)


def test_a_pod_that_its_replica_set_released_is_gated_again(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), workload())
    (own,) = until(lambda: [pod for pod in _own(fleet) if names.INSTANCE in pod["metadata"]["labels"]], "its pod")
    ours = {key: None for key in own["metadata"]["labels"] if key.startswith(f"{names.GROUP}/")}
    fleet.cluster.patch(own, {"metadata": {"labels": ours}})
    until(lambda: not _own_pods_ungated(fleet), "every pod of the workload to be behind the gate", seconds=20)
    until(lambda: len(_own(fleet)) == 1, "the ReplicaSet to delete the pod that is too many")


def _own_pods_ungated(fleet: Fleet) -> list[str]:
    """Pods of the namespace that no policy selects. Monitors and discovery servers are not instances."""
    found = [pod["metadata"] for pod in fleet.pods(f"!{names.MONITORED}")]
    return [one["name"] for one in found if (one.get("labels") or {}).get(names.INSTANCE) != one["name"]]
