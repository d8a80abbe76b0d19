"""The gate object of a mux is a Lease: a compromised monitor cannot write what no correct one writes, and that can do its work."""

from __future__ import annotations

import pytest

from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import ACTIVE, MINE, OTHER, OWNER, STANDBY, refusal
from tests.cluster.operators import Fleet, Operator, policy, workload
from tests.support.cluster import Cluster, Object, until
from understudy.api import names
from understudy.kube.client import Client
from understudy.kube.gates.base import GateKind, GateRecord, Reach
from understudy.kube.gates.registry import KINDS

KIND = KINDS["Mux"]


@pytest.fixture
def gate(cluster: Cluster, release: Release, namespace: str) -> Object:
    """A gate at epoch 7, open for ACTIVE."""
    made = KIND.closed(MINE, Reach(), epoch=7)
    made["metadata"] |= {"labels": {"app.kubernetes.io/managed-by": "understudy"}, "ownerReferences": [OWNER]}
    made["metadata"]["annotations"] |= {names.ACTIVE: ACTIVE, names.ACTIVE_UID: "uid-a"}
    made["spec"]["holderIdentity"] = ACTIVE
    return cluster.create(made, namespace)


@pytest.fixture
def kind() -> GateKind:
    """The kind of that gate."""
    return KIND


@pytest.mark.parametrize("holder", [STANDBY, None])
def test_a_gate_lets_through_only_whom_its_record_names(
    cluster: Cluster, compromised_monitor: str, gate: Object, holder: str | None
) -> None:
    assert "may let through only the instances that the gate's record names" in refusal(
        lambda: cluster.patch(gate, {"spec": {"holderIdentity": holder}}, user=compromised_monitor)
    )


def test_a_record_names_only_whom_its_gate_lets_through(
    cluster: Cluster, compromised_monitor: str, gate: Object
) -> None:
    commit = KIND.commitment(MINE, over=GateRecord.of(gate), active=STANDBY, active_uid="uid-b")
    del commit["spec"]
    assert "may let through only" in refusal(lambda: cluster.patch(gate, commit, user=compromised_monitor))


@pytest.mark.parametrize(
    "change",
    [
        {"spec": {"leaseTransitions": 3}},
        {"spec": {"leaseDurationSeconds": 3}},
        {"metadata": {"labels": {"app.kubernetes.io/managed-by": None}}},
        {"metadata": {"ownerReferences": []}},
    ],
)
def test_a_monitor_writes_holder_and_record_and_nothing_else(
    cluster: Cluster, compromised_monitor: str, gate: Object, change: Object
) -> None:
    assert "of its gate only" in refusal(lambda: cluster.patch(gate, change, user=compromised_monitor))


def test_the_epoch_grows_by_one_with_each_commit(cluster: Cluster, compromised_monitor: str, gate: Object) -> None:
    commit = KIND.commitment(MINE, over=GateRecord.of(gate), active=STANDBY, active_uid="uid-b")
    for epoch in ("6", "7", "9", None):
        commit["metadata"]["annotations"][names.EPOCH] = epoch
        assert "must increase the epoch" in refusal(lambda: cluster.patch(gate, commit, user=compromised_monitor))


def test_a_monitor_writes_no_other_lease(cluster: Cluster, namespace: str, compromised_monitor: str) -> None:
    other = cluster.create(KIND.closed(OTHER, Reach(), epoch=7), namespace)
    body = {"metadata": {"annotations": {names.OVERTAKEN: "r"}}}
    assert "cannot patch resource" in refusal(lambda: cluster.patch(other, body, user=compromised_monitor))


async def test_a_correct_monitor_commits_admits_and_closes(
    correct_monitor: Client, cluster: Cluster, namespace: str, gate: Object
) -> None:
    async def write(patch: Object) -> Object:
        return await KIND.write(correct_monitor, namespace, MINE, patch)

    closed = await write(KIND.commitment(MINE, over=GateRecord.of(gate), recovery='{"id": "r"}', waits_for="spare"))
    assert (KIND.let_through(closed), closed["metadata"]["labels"][names.WAITS_FOR]) == ((), "spare")
    opened = await write(KIND.commitment(MINE, over=GateRecord.of(closed), active=STANDBY, active_uid="uid-b"))
    assert (GateRecord.of(opened).epoch, KIND.let_through(opened)) == (9, (STANDBY,))
    both = await write(KIND.admission(MINE, over=GateRecord.of(opened), admitted=ACTIVE, admitted_uid="uid-a"))
    assert (GateRecord.of(both).admitted, KIND.let_through(both)) == (ACTIVE, (STANDBY,))
    ended = await write(KIND.noting(over=GateRecord.of(both), recovery='{"result": "Recovered"}'))
    edited = cluster.patch(ended, {"spec": {"holderIdentity": ACTIVE}})
    over = {"metadata": {"resourceVersion": edited["metadata"]["resourceVersion"]}}
    repaired = await write(over | KIND.routing_repair(edited, MINE, STANDBY, ACTIVE))
    assert KIND.let_through(repaired) == (STANDBY,)


def test_the_operator_creates_the_lease_and_restores_it(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), workload(gate={"kind": "Mux"}))
    gate = until(lambda: fleet.find("Lease", names.gate("w"), "coordination.k8s.io/v1"), "the gate")
    fleet.cluster.patch(gate, KIND.commitment("w", over=GateRecord.of(gate), active="w-a", active_uid="uid-a"))
    fleet.cluster.patch(gate, {"spec": {"holderIdentity": "w-b"}})

    def restored() -> bool:
        found = fleet.find("Lease", names.gate("w"), "coordination.k8s.io/v1")
        return found is not None and KIND.let_through(found) == ("w-a",)

    until(restored, "the holder that the record names", seconds=10)
