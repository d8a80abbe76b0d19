"""Writes to a gate, as a monitor makes them."""

from __future__ import annotations

from understudy.kube.client import Client, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE


async def commit(client: Client, namespace: str, workload: str, *, over: GateRecord, **more: str) -> Object:
    """Name the pod that may reach the robot; the gate object then."""
    return await GATE.write(client, namespace, workload, GATE.commitment(workload, over=over, **more))


async def admit(
    client: Client, namespace: str, workload: str, *, over: GateRecord, admitted: str, admitted_uid: str
) -> Object:
    """Let a standby through beside it; the gate object then."""
    patch = GATE.admission(workload, over=over, admitted=admitted, admitted_uid=admitted_uid)
    return await GATE.write(client, namespace, workload, patch)
