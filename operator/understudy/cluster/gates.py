"""The gate of a workload as a NetworkPolicy: what it says, and the one patch that changes it."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.api import names
from understudy.cluster.client import NETWORK_POLICIES, Client, Object


@dataclass(frozen=True)
class GateRecord:
    """What a gate's policy says."""

    epoch: int
    active: str
    active_uid: str
    recovery: str
    """JSON of the recovery that committed it, or empty."""
    version: str


def read(policy: Object) -> GateRecord:
    """The record in a gate's annotations."""
    annotations = policy["metadata"].get("annotations") or {}
    epoch = annotations.get(names.EPOCH, "0")
    return GateRecord(
        epoch=int(epoch) if epoch.isdigit() else 0,
        active=annotations.get(names.ACTIVE, ""),
        active_uid=annotations.get(names.ACTIVE_UID, ""),
        recovery=annotations.get(names.RECOVERY, ""),
        version=policy["metadata"]["resourceVersion"],
    )


def selected(policy: Object) -> str:
    """The instance that a gate's selector really lets through, whatever the annotations say; empty for none."""
    value: str = policy["spec"].get("podSelector", {}).get("matchLabels", {}).get(names.INSTANCE, "")
    return "" if value == names.GATE_CLOSED else value


async def commit(
    client: Client, namespace: str, workload: str, *, over: GateRecord, active: str, active_uid: str, recovery: str
) -> Object:
    """Name the one pod that may reach the robot (none if ``active`` is empty), over exactly the record given.

    One atomic write fences the old pod and routes the new one. Raises ApiError: 409 when another commit was first.
    """
    return await client.patch(
        NETWORK_POLICIES,
        namespace,
        names.gate(workload),
        {
            "metadata": {
                "resourceVersion": over.version,
                "annotations": {
                    names.EPOCH: str(over.epoch + 1),
                    names.ACTIVE: active,
                    names.ACTIVE_UID: active_uid,
                    names.RECOVERY: recovery,
                },
            },
            "spec": {
                "podSelector": {"matchLabels": {names.WORKLOAD: workload, names.INSTANCE: active or names.GATE_CLOSED}}
            },
        },
    )
