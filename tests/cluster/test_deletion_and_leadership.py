"""Deletion leaves nothing behind, and one of several operators leads, on a real API server."""

from __future__ import annotations

import signal
import socket
import time
import uuid
from contextlib import ExitStack

import pytest

from tests.cluster.operator_objects import OURS
from tests.cluster.operators import BUILT, CORE, Fleet, Operator, hot, leader, policy, process, ready, spare, workload
from tests.support.cluster import Cluster, Refused, until
from understudy.api import names
from understudy.controller.runtime import process as running

# -- the end ------------------------------------------------------------------------------------------------------------


def test_nothing_is_left_of_a_deleted_workload_and_pool(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot", "spare"), hot(), spare(), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2 and len(fleet.held()) == 2, "all pods")
    for kind, name in (
        ("RobotWorkload", "w"),
        ("FallbackPool", "hot"),
        ("FallbackPool", "spare"),
        ("FailurePolicy", "policy"),
    ):
        fleet.cluster.delete(fleet.get(kind, name))

    def left() -> list[str]:
        found = [
            f"{kind}/{item['metadata']['name']}"
            for api_version, kind in BUILT
            for item in fleet.cluster.list(api_version, kind, fleet.namespace, labels=OURS)
        ]
        return found + [pod["metadata"]["name"] for pod in fleet.pods(names.COMPONENT)]

    until(lambda: not left(), "nothing to be left", seconds=30)
    time.sleep(2)
    assert left() == []


@pytest.mark.usefixtures("alone")
def test_a_namespace_is_deleted_with_everything_in_it(cluster: Cluster) -> None:
    name = f"test-{uuid.uuid4().hex[:8]}"
    item = cluster.create({"apiVersion": CORE, "kind": "Namespace", "metadata": {"name": name}})
    fleet = Fleet(cluster, name)
    # the operator's Lease is elsewhere: a namespace's deletion mustn't end it
    with Operator(cluster.kubeconfig, name):
        fleet.create(policy("hot", "spare"), hot(), spare(), workload())
        fleet.wait_built()
        cluster.delete(item)
        until(lambda: cluster.find(CORE, "Namespace", name) is None, "the namespace to be gone", seconds=60)


# -- leadership ---------------------------------------------------------------------------------------------------------


def test_of_two_candidates_one_leads_and_the_other_follows_a_kill(fleet: Fleet) -> None:
    with ExitStack() as stack:
        processes = {identity: stack.enter_context(process(fleet, identity)) for identity in ("one", "two")}
        first = until(lambda: leader(fleet), "a leader", seconds=60)
        fleet.create(policy("hot"), hot(), workload())
        fleet.wait_built()
        until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
        before = fleet.settled()
        processes[first].kill()
        killed = time.monotonic()
        second = until(lambda: leader(fleet) not in ("", first) and leader(fleet), "another leader", seconds=30)
        assert second in processes
        assert time.monotonic() - killed < 25
        time.sleep(2)
        assert fleet.versions() == before
        fleet.cluster.delete(next(p for p in fleet.instances() if names.POOL in p["metadata"]["labels"]))
        until(lambda: len(fleet.instances()) == 2, "another standby, made by the new leader")


def test_a_leader_that_is_terminated_hands_over_at_once(fleet: Fleet) -> None:
    with process(fleet, "one") as one:
        until(lambda: leader(fleet) == "one", "a leader", seconds=60)
        with socket.create_server(("", 0)) as free:
            port: int = free.getsockname()[1]
        with process(fleet, "two", port):
            until(lambda: ready(port), "the other one to be ready", seconds=60)
            one.send_signal(signal.SIGTERM)
            assert one.wait(20) == 0
            until(lambda: leader(fleet) == "two", "the other to lead", seconds=6)


def test_an_operator_that_loses_its_lease_starts_again_and_stands_by(fleet: Fleet) -> None:
    with socket.create_server(("", 0)) as free:
        port: int = free.getsockname()[1]
    with process(fleet, "one", port) as one:
        until(lambda: leader(fleet) == "one" and ready(port), "a leader", seconds=60)
        lease = fleet.cluster.get("coordination.k8s.io/v1", "Lease", running.LEASE, fleet.namespace)
        fleet.cluster.patch(lease, {"spec": {"holderIdentity": "thief", "leaseDurationSeconds": 600}})
        until(lambda: not ready(port), "it to stop", seconds=20)
        until(lambda: ready(port), "it to start again", seconds=60)
        assert leader(fleet) == "thief"
        lease = fleet.cluster.get("coordination.k8s.io/v1", "Lease", running.LEASE, fleet.namespace)
        fleet.cluster.patch(lease, {"spec": {"holderIdentity": ""}})
        until(lambda: leader(fleet) == "one", "it to lead again", seconds=60)
        assert one.poll() is None


def test_an_operator_that_does_not_lead_writes_nothing(fleet: Fleet) -> None:
    lease = {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": running.LEASE},
        "spec": {"holderIdentity": "other", "leaseDurationSeconds": 600},
    }
    fleet.create(lease, policy("hot"), hot(), workload())
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=1):
        time.sleep(4)
        assert "status" not in fleet.get("RobotWorkload", "w")
        with pytest.raises(Refused):
            fleet.gate()
