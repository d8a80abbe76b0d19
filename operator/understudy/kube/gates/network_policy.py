"""The gate of a workload as a NetworkPolicy: what it says, and the patches that change it, each one atomic write."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.api import names
from understudy.kube.client import NETWORK_POLICIES, Client, Object


@dataclass(frozen=True)
class GateRecord:
    """What a gate's policy says."""

    epoch: int
    active: str
    active_uid: str
    recovery: str
    """JSON of the recovery that committed it, or empty."""
    version: str
    admitted: str = ""
    """The standby that is let through too, for the reflex."""
    admitted_uid: str = ""


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
        admitted=annotations.get(names.ADMITTED, ""),
        admitted_uid=annotations.get(names.ADMITTED_UID, ""),
    )


def selected(policy: Object) -> tuple[str, ...]:
    """The instances that a gate's selector really lets through, whatever the annotations say."""
    selector = policy["spec"].get("podSelector") or {}
    values = [(selector.get("matchLabels") or {}).get(names.INSTANCE)]
    for expression in selector.get("matchExpressions") or []:
        if (expression["key"], expression["operator"]) == (names.INSTANCE, "In"):
            values += expression["values"]
    return tuple(value for value in values if value and value != names.GATE_CLOSED)


def _selector(workload: str, active: str, admitted: str = "") -> Object:
    """As merge patches need it: each shape removes the other."""
    if admitted:
        among = {"key": names.INSTANCE, "operator": "In", "values": [active, admitted]}
        return {"matchLabels": {names.WORKLOAD: workload, names.INSTANCE: None}, "matchExpressions": [among]}
    return {
        "matchLabels": {names.WORKLOAD: workload, names.INSTANCE: active or names.GATE_CLOSED},
        "matchExpressions": None,
    }


async def commit(
    client: Client,
    namespace: str,
    workload: str,
    *,
    over: GateRecord,
    active: str,
    active_uid: str,
    recovery: str,
    waits_for: str = "",
) -> Object:
    """Name the one pod that may reach the robot (none if ``active`` is empty), over exactly the record given.

    ``waits_for`` is the shared pool that the workload waits for a pod of, if it does.

    One atomic write fences the old pod and routes the new one; a standby that was admitted beside it is let through no
    longer. Raises ApiError: 409 when another commit was first.
    """
    body = commitment(workload, over=over, active=active, active_uid=active_uid, recovery=recovery, waits_for=waits_for)
    return await client.patch(NETWORK_POLICIES, namespace, names.gate(workload), body)


def commitment(
    workload: str,
    *,
    over: GateRecord,
    active: str = "",
    active_uid: str = "",
    recovery: str = "",
    waits_for: str = "",
) -> Object:
    """The merge patch of :func:`commit`; of a gate that is to be closed where nothing more is given."""
    return {
        "metadata": {
            "resourceVersion": over.version,
            "labels": {names.WAITS_FOR: waits_for or None},
            "annotations": {
                names.EPOCH: str(over.epoch + 1),
                names.ACTIVE: active,
                names.ACTIVE_UID: active_uid,
                names.RECOVERY: recovery,
                names.ADMITTED: "",
                names.ADMITTED_UID: "",
            },
        },
        "spec": {"podSelector": _selector(workload, active)},
    }


async def end_recovery(client: Client, namespace: str, workload: str, *, over: GateRecord, recovery: str) -> Object:
    """Have what stands beside it say that nobody goes on with the recovery that committed it last, over exactly the record.

    ``recovery`` is its JSON from then on. Control doesn't change, and so the epoch stays; for a pod of a shared pool it waits no
    longer. Raises ApiError: 409 when another write was first.
    """
    body = {
        "metadata": {
            "resourceVersion": over.version,
            "labels": {names.WAITS_FOR: None},
            "annotations": {names.RECOVERY: recovery},
        }
    }
    return await client.patch(NETWORK_POLICIES, namespace, names.gate(workload), body)


async def admit(
    client: Client, namespace: str, workload: str, *, over: GateRecord, admitted: str, admitted_uid: str
) -> Object:
    """Let a standby through beside the pod in control (only that one if ``admitted`` is empty), over exactly the record.

    Control doesn't change, and so the epoch stays. Raises ApiError: 409 when another write was first; ValueError when
    the gate is closed, since then nobody may reach the robot.
    """
    if not over.active:
        raise ValueError(f"NetworkPolicy {names.gate(workload)} is closed: no standby can be let through")
    return await client.patch(
        NETWORK_POLICIES,
        namespace,
        names.gate(workload),
        {
            "metadata": {
                "resourceVersion": over.version,
                "annotations": {names.ADMITTED: admitted, names.ADMITTED_UID: admitted_uid},
            },
            "spec": {"podSelector": _selector(workload, over.active, admitted)},
        },
    )
