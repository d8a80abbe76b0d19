"""Claiming a pod of a shared pool: one optimistic write that exactly one workload can win."""

from __future__ import annotations

import time

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.cluster.client import PODS, ApiError, Client, Object


async def claim(client: Client, pod: Object, *, workload: str, workload_uid: str, claim: str) -> Object:
    """Make an unclaimed pod an instance of a workload, which from then on owns it.

    A pod that has changed since it was read but is still unclaimed (the kubelet writes its status) is tried again.
    Raises ApiError: 409 when another workload's claim was first, 404 when the pod is gone.
    """
    while True:
        try:
            return await _write(client, pod, workload, workload_uid, claim)
        except ApiError as error:
            if not error.conflict:
                raise
            fresh = await client.get(PODS, pod["metadata"]["namespace"], pod["metadata"]["name"])
            if not unclaimed(fresh) or fresh["metadata"]["uid"] != pod["metadata"]["uid"]:
                raise
            pod = fresh


def unclaimed(pod: Object) -> bool:
    """Whether a pod of a shared pool belongs to no workload and isn't being deleted."""
    metadata = pod["metadata"]
    return (metadata.get("labels") or {}).get(names.HELD) == "true" and not metadata.get("deletionTimestamp")


async def _write(client: Client, pod: Object, workload: str, workload_uid: str, claim: str) -> Object:
    metadata = pod["metadata"]
    return await client.patch(
        PODS,
        metadata["namespace"],
        metadata["name"],
        {
            "metadata": {
                "uid": metadata["uid"],
                "resourceVersion": metadata["resourceVersion"],
                "labels": {names.HELD: None, names.WORKLOAD: workload},
                "annotations": {names.CLAIM: claim, names.CLAIMED_AT: str(int(time.time()))},
                "ownerReferences": [
                    {
                        "apiVersion": API_VERSION,
                        "kind": "RobotWorkload",
                        "name": workload,
                        "uid": workload_uid,
                        "controller": True,
                        "blockOwnerDeletion": False,
                    }
                ],
            }
        },
    )
