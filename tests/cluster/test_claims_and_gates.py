"""The two writes that ownership of a robot depends on, under contention, on a real API server."""

from __future__ import annotations

import asyncio
import os
import uuid
from collections.abc import AsyncIterator

import pytest

from tests.cluster.conftest import Release
from tests.support import gates
from understudy.api import names
from understudy.kube import claims
from understudy.kube.client import NAMESPACES, NETWORK_POLICIES, PODS, ApiError, Client
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE
from understudy.kube.kubeconfig import load_access

CONTENDERS = 12


@pytest.fixture
async def client() -> AsyncIterator[Client]:
    async with Client(load_access(os.environ.get("KUBECONFIG"))) as client:
        yield client


@pytest.fixture
async def space(client: Client, release: Release) -> AsyncIterator[str]:
    """A namespace in which the chart's admission policies let the tests claim pods."""
    name = f"claims-{uuid.uuid4().hex[:6]}"
    await client.create(NAMESPACES, None, {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}})
    yield name
    await client.delete(NAMESPACES, None, name)


async def test_of_many_claims_on_one_pod_exactly_one_wins(client: Client, space: str) -> None:
    pod = await client.create(
        PODS,
        space,
        {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": {"name": "spare", "labels": {names.POOL: "p", names.HELD: "true"}},
            "spec": {"containers": [{"name": "c", "image": "none.invalid/none"}], "nodeSelector": {"no": "node"}},
        },
    )
    pod = await client.get(PODS, space, "spare")
    outcomes = await asyncio.gather(
        *(
            claims.claim(client, pod, workload=f"robot-{i}", workload_uid=f"uid-{i}", claim=f"uid-{i}/r")
            for i in range(CONTENDERS)
        ),
        return_exceptions=True,
    )
    won = [o for o in outcomes if isinstance(o, dict)]
    lost = [o for o in outcomes if isinstance(o, ApiError)]
    assert len(won) == 1
    assert len(lost) == CONTENDERS - 1
    # 404: the garbage collector may have taken the pod already, since its new owner is none that exists.
    assert all(error.conflict or error.not_found for error in lost)
    labels = won[0]["metadata"]["labels"]
    assert names.HELD not in labels
    assert [owner["name"] for owner in won[0]["metadata"]["ownerReferences"]] == [labels[names.WORKLOAD]]


def gates_body(workload: str) -> dict[str, object]:
    """A closed gate, as the operator makes it."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": names.gate(workload), "annotations": {names.EPOCH: "0"}},
        "spec": {
            "podSelector": {"matchLabels": {names.WORKLOAD: workload, names.INSTANCE: names.NOBODY}},
            "policyTypes": ["Egress"],
            "egress": [{}],
        },
    }


async def test_of_many_commits_at_one_epoch_exactly_one_wins(client: Client, space: str) -> None:
    workload = "robot"
    policy = await client.create(NETWORK_POLICIES, space, gates_body(workload))
    for epoch in range(5):
        record = GateRecord.of(policy)
        assert record.epoch == epoch
        outcomes = await asyncio.gather(
            *(
                gates.commit(
                    client, space, workload, over=record, active=f"robot-{i}", active_uid=f"uid-{i}", recovery=""
                )
                for i in range(CONTENDERS)
            ),
            return_exceptions=True,
        )
        won = [o for o in outcomes if isinstance(o, dict)]
        assert len(won) == 1
        policy = await client.get(NETWORK_POLICIES, space, names.gate(workload))
        after = GateRecord.of(policy)
        assert after.epoch == epoch + 1
        assert after.active == GateRecord.of(won[0]).active
        assert GATE.let_through(policy) == (after.active,), "selector and record say the same"


async def test_a_standby_is_let_through_beside_the_one_in_control_until_the_next_commit(
    client: Client, space: str
) -> None:
    gate = await client.create(NETWORK_POLICIES, space, gates_body("robot"))
    with pytest.raises(ValueError, match="closed"):
        await gates.admit(client, space, "robot", over=GateRecord.of(gate), admitted="robot-b", admitted_uid="uid-b")
    opened = await gates.commit(
        client, space, "robot", over=GateRecord.of(gate), active="robot-a", active_uid="uid-a", recovery=""
    )
    before = GateRecord.of(opened)
    both = await gates.admit(client, space, "robot", over=before, admitted="robot-b", admitted_uid="uid-b")
    assert GATE.let_through(both) == ("robot-a", "robot-b")
    assert (GateRecord.of(both).epoch, GateRecord.of(both).active) == (before.epoch, "robot-a"), (
        "control is where it was"
    )
    with pytest.raises(ApiError) as refused:
        await gates.admit(client, space, "robot", over=before, admitted="robot-c", admitted_uid="uid-c")
    assert refused.value.status == 409, "what was seen before another write doesn't count"
    without = await gates.admit(client, space, "robot", over=GateRecord.of(both), admitted="", admitted_uid="")
    assert GATE.let_through(without) == ("robot-a",)
    again = await gates.admit(
        client, space, "robot", over=GateRecord.of(without), admitted="robot-b", admitted_uid="uid-b"
    )
    switched = await gates.commit(
        client, space, "robot", over=GateRecord.of(again), active="robot-b", active_uid="uid-b", recovery=""
    )
    assert GATE.let_through(switched) == ("robot-b",), "one write fences the one and leaves the other"
    assert GateRecord.of(switched).admitted == ""
    closed = await gates.commit(
        client, space, "robot", over=GateRecord.of(switched), active="", active_uid="", recovery=""
    )
    assert GATE.let_through(closed) == ()


async def test_the_gates_of_those_that_wait_for_a_pod_are_found_by_their_label(client: Client, space: str) -> None:
    gate = await client.create(NETWORK_POLICIES, space, gates_body("robot"))

    async def waiting() -> list[str]:
        found = await client.list(NETWORK_POLICIES, space, labels=names.WAITS_FOR)
        return [item["metadata"]["name"] for item in found["items"]]

    assert await waiting() == []
    closed = await gates.commit(
        client, space, "robot", over=GateRecord.of(gate), active="", active_uid="", recovery="", waits_for="spare"
    )
    assert closed["metadata"]["labels"][names.WAITS_FOR] == "spare"
    assert await waiting() == [names.gate("robot")]
    await gates.commit(client, space, "robot", over=GateRecord.of(closed), active="", active_uid="", recovery="")
    assert await waiting() == []
