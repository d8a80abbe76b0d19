"""Claiming a pod of a shared pool: one optimistic write that exactly one workload can win."""

from __future__ import annotations

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.cluster.client import PODS, Client, Object


async def claim(client: Client, pod: Object, *, workload: str, workload_uid: str, claim: str) -> Object:
    """Make an unclaimed pod an instance of a workload, which from then on owns it.

    Raises ApiError: 409 when the pod has changed since it was read, such as by another claim, 404 when it is gone.
    """
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
                "annotations": {names.CLAIM: claim},
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
