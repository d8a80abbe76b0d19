"""Claims a pod of a shared pool, with one optimistic write that exactly one workload can win."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Iterable, Mapping

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.kube.apply import controller_of
from understudy.kube.client import FAILURES, JSON, PODS, ApiError, Client, Object
from understudy.kube.repeated_requests import RETRY_FIRST, RETRY_MOST, TRY_WITHIN, answered, unanswered

PARTS = 16
"""Number of parts of a shared pool. A workload asks for one part of the pods, since all pods of a large pool are a
megabyte."""


def part(key: str) -> str:
    """Return the part of a pool that a pod belongs to (by its name), or that a workload asks for first (by its UID)."""
    return str(hashlib.sha256(key.encode()).digest()[0] % PARTS)


def claimed(pods: Iterable[Object]) -> list[str]:
    """Return the names of claimed pods that the policies of a workload select by their names only."""
    found = (pod["metadata"] for pod in pods)
    return sorted(one["name"] for one in found if (one.get("labels") or {}).get(names.CLAIMED_BY))


async def claim(client: Client, pod: Object, *, workload: str, workload_uid: str, claim: str) -> Object:
    """Make an unclaimed pod an instance of a workload, which owns the pod from then on.

    If the pod was read whole, the write applies to that version only. If only its name is known, from a table, the pod
    is claimed if it is unclaimed and belongs to its pool at the time of the write.

    If the pod has changed since it was read but is still unclaimed (the kubelet writes its status), the claim is tried
    again. A claim without an answer is also tried again, once it is known that it was not carried out: otherwise the
    pod would belong to a workload that does not know of it. Raises ApiError: 409 if another workload's claim came
    first, 404 if the pod does not exist.
    """
    retry = RETRY_FIRST
    while True:
        whole = "resourceVersion" in pod["metadata"]
        try:
            async with asyncio.timeout(TRY_WITHIN):
                return await (_write if whole else _test_and_write)(client, pod, workload, workload_uid, claim)
        except FAILURES as error:
            changed = isinstance(error, ApiError) and error.status == (409 if whole else 422)
            if not changed and not unanswered(error):
                raise
            if not changed:
                await asyncio.sleep(retry)
                retry = min(2 * retry, RETRY_MOST)
            fresh = await _reread(client, pod)
            if (fresh["metadata"].get("annotations") or {}).get(names.CLAIM) == claim:
                return fresh
            if not unclaimed(fresh) or not _same(fresh, pod):
                raise ApiError(409, "Conflict", f"pod {pod['metadata']['name']} is not free any more") from error
            pod = fresh


async def _reread(client: Client, pod: Object) -> Object:
    """Read the pod again. Waits while the API server cannot be reached."""
    return await answered(lambda: client.get(PODS, pod["metadata"]["namespace"], pod["metadata"]["name"]))


def pool_of(pod: Object) -> str:
    """Return the pool that made a pod; empty if none did. A claimed pod whose label somebody has removed still has the Secret of its pool,
    since nobody can change that."""
    if label := (pod["metadata"].get("labels") or {}).get(names.POOL, ""):
        return str(label)
    evidence = pool_evidence(pod)
    return names.pool_of_secret(evidence["secret"]["secretName"]) if evidence is not None else ""


def pool_evidence(pod: Object) -> Object | None:
    """Return the volume that shows the pool of a claimed pod without the label; None if the label is there.

    Whoever may patch pods may annotate one with a claim: only a pod that a RobotWorkload owns can have been claimed.
    """
    metadata, owner = pod["metadata"], controller_of(pod) or {}
    if names.POOL in (metadata.get("labels") or {}) or names.CLAIM not in (metadata.get("annotations") or {}):
        return None
    if owner.get("kind") != "RobotWorkload":
        return None
    volumes = (pod.get("spec") or {}).get("volumes") or []
    return next((volume for volume in volumes if volume["name"] == names.TOKEN_VOLUME), None)


def workload_of(labels: Mapping[str, str]) -> str:
    """Return the workload whose instance a pod with these labels is; empty if it is none."""
    return labels.get(names.CLAIMED_BY) or labels.get(names.WORKLOAD) or ""


def instance_labels(pod: Object, workload: str) -> dict[str, str]:
    """Return the labels of an instance of a workload that policies and watches select by. The pod may lack some of them.

    A monitor of an earlier version claims a pod of a shared pool with the label of other instances.
    """
    found, present = {names.INSTANCE: pod["metadata"]["name"]}, pod["metadata"].get("labels") or {}
    if {names.CLAIMED_BY, names.HELD} & present.keys() and present.get(names.WORKLOAD) != workload:
        return found | {names.CLAIMED_BY: workload, names.WORKLOAD: names.UNCLAIMED, names.HELD: "true"}
    return found | {names.WORKLOAD: workload}


def is_held(labels: Mapping[str, str]) -> bool:
    """Whether a pod with these labels is of a shared pool, and no workload has claimed it."""
    return labels.get(names.HELD) == "true" and not labels.get(names.CLAIMED_BY)


def unclaimed(pod: Object) -> bool:
    """Whether a pod of a shared pool belongs to no workload and is not being deleted."""
    metadata = pod["metadata"]
    return is_held(metadata.get("labels") or {}) and not metadata.get("deletionTimestamp")


def _same(fresh: Object, pod: Object) -> bool:
    """Whether a pod that was read again is the pod that was meant."""
    if "resourceVersion" in pod["metadata"]:
        return bool(fresh["metadata"]["uid"] == pod["metadata"]["uid"])
    return bool(pod["metadata"]["labels"].items() <= fresh["metadata"]["labels"].items())


async def _write(client: Client, pod: Object, workload: str, workload_uid: str, claim: str) -> Object:
    metadata = pod["metadata"]
    body = {
        "metadata": {
            "uid": metadata["uid"],
            "resourceVersion": metadata["resourceVersion"],
            "labels": _claimed(metadata.get("labels") or {}, workload),
            "annotations": _annotations(claim),
            "ownerReferences": [_owner(workload, workload_uid)],
        }
    }
    return await client.patch(PODS, metadata["namespace"], metadata["name"], body)


async def _test_and_write(client: Client, pod: Object, workload: str, workload_uid: str, claim: str) -> Object:
    """Claim the pod with a JSON patch (RFC 6902).

    The API server applies all of it to the pod's present version, or refuses with 422. It also refuses if the pod has
    no annotations at all.
    """
    metadata = pod["metadata"]
    body = [{"op": "test", "path": _path("labels", key), "value": value} for key, value in metadata["labels"].items()]
    for key, value in _claimed(metadata["labels"], workload).items():
        body.append(
            {"op": "remove" if value is None else "add", "path": _path("labels", key)}
            | ({"value": value} if value else {})
        )
    for key, value in _annotations(claim).items():
        body.append({"op": "add", "path": _path("annotations", key), "value": value})
    body.append({"op": "add", "path": _path("ownerReferences"), "value": [_owner(workload, workload_uid)]})
    made = await client.patch(PODS, metadata["namespace"], metadata["name"], body, kind=JSON)
    if made["metadata"].get("deletionTimestamp"):
        raise ApiError(404, "NotFound", f"pod {metadata['name']} is being deleted")
    return made


def _claimed(labels: Mapping[str, str], workload: str) -> dict[str, str | None]:
    """Return the change of the labels of a pod that is claimed. The pods of earlier versions lack CLAIMED_BY."""
    if names.CLAIMED_BY in labels:
        return {names.CLAIMED_BY: workload}
    return {names.HELD: None, names.WORKLOAD: workload}


def _path(*keys: str) -> str:
    """Return a JSON pointer (RFC 6901) into an object's metadata."""
    return "/".join(["/metadata", *(key.replace("~", "~0").replace("/", "~1") for key in keys)])


def _annotations(claim: str) -> dict[str, str]:
    return {names.CLAIM: claim, names.CLAIMED_AT: str(int(time.time()))}


def _owner(workload: str, uid: str) -> Object:
    return {
        "apiVersion": API_VERSION,
        "kind": "RobotWorkload",
        "name": workload,
        "uid": uid,
        "controller": True,
        "blockOwnerDeletion": False,
    }
