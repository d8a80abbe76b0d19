"""Writes to a gate, as a monitor makes them."""

from __future__ import annotations

from understudy.kube.client import Client, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE


async def commit(client: Client, namespace: str, workload: str, *, over: GateRecord, **more: str) -> Object:
    """Commit the pod that may reach the robot, and return the gate object."""
    return await GATE.write(client, namespace, workload, GATE.commitment(workload, over=over, **more))


async def admit(
    client: Client, namespace: str, workload: str, *, over: GateRecord, admitted: str, admitted_uid: str
) -> Object:
    """Let a standby through beside the active pod, and return the gate object."""
    patch = GATE.admission(workload, over=over, admitted=admitted, admitted_uid=admitted_uid)
    return await GATE.write(client, namespace, workload, patch)
