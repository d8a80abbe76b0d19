"""Creates and updates objects without overwriting objects of others.

Whole objects are written by server-side apply (KEP-555), so that a field that is no longer wanted is removed. They are
written only if something differs, so that a cluster at rest sees no writes.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from understudy.api import names
from understudy.api.base import GROUP
from understudy.kube.client import APPLY, ApiError, Client, Object, Resource

APPLIED = f"{GROUP}/applied"
"""Annotation with the hash of what was applied last. It shows that a field was withdrawn, which the live object cannot
show."""


class OwnedByOther(Exception):
    """An object of that name exists and belongs to another owner. It was not changed."""

    def __init__(self, kind: str, namespace: str, name: str, owner: str) -> None:
        super().__init__(
            f'{kind} "{name}" exists in namespace {namespace} and belongs to {owner}; it was left as it is. '
            f"Delete or rename it"
        )


def digest(value: Any, length: int = 10) -> str:
    """Return a short stable hash of plain data."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def controller_of(item: Object) -> Object | None:
    """Return the owner reference of the object's controller."""
    for owner in item["metadata"].get("ownerReferences") or []:
        if owner.get("controller"):
            found: Object = owner
            return found
    return None


def owned_by(item: Object, uid: str) -> bool:
    """Return whether an object's controller has this UID."""
    owner = controller_of(item)
    return owner is not None and owner.get("uid") == uid


def released(pod: Object) -> str:
    """Return the workload whose instance a pod is although no controller owns it; empty for other pods.

    A ReplicaSet releases a pod as soon as somebody changes a label of its selector. The agent's environment still shows
    the workload, because nobody can change the environment of a pod.
    """
    if controller_of(pod) is not None:
        return ""
    for container in (pod.get("spec") or {}).get("containers") or []:
        if container.get("name") == names.AGENT_CONTAINER:
            for entry in container.get("env") or []:
                if entry.get("name") == names.WORKLOAD_VARIABLE:
                    found: str = entry.get("value") or ""
                    return found
    return ""


def released_spec(workload: str) -> Object:
    """Return the part of a released pod's spec from which :func:`released` reads the workload."""
    environment = [{"name": names.WORKLOAD_VARIABLE, "value": workload}]
    return {"containers": [{"name": names.AGENT_CONTAINER, "env": environment}]}


def stamped(body: Object) -> Object:
    """Return the object with its own hash in an annotation."""
    metadata = body["metadata"]
    annotations = {**(metadata.get("annotations") or {}), APPLIED: digest(body)}
    return {**body, "metadata": {**metadata, "annotations": annotations}}


def differences(live: Any, desired: Any, path: str = "") -> list[str]:
    """Return the paths at which the live object lacks what is desired.

    What only the live object has (defaults, status) is ignored. The API server leaves out empty values, so these count
    as present.
    """
    if live is None and not desired:
        return []
    if isinstance(desired, dict):
        if not isinstance(live, dict):
            return [path] if desired else []
        return [found for key in desired for found in differences(live.get(key), desired[key], f"{path}.{key}")]
    if isinstance(desired, list):
        if not isinstance(live, list) or len(live) != len(desired):
            return [path] if desired or live else []
        return [
            found
            for i, (a, b) in enumerate(zip(live, desired, strict=True))
            for found in differences(a, b, f"{path}[{i}]")
        ]
    return [] if live == desired else [path]


async def establish(client: Client, resource: Resource, namespace: str, body: Object, *, manager: str) -> Object:
    """Create by server-side apply an object that should not exist yet, or update one that already has our owner.

    Raises OwnedByOther if the object exists with another controller, and ApiError.
    """
    name = body["metadata"]["name"]
    live = await client.find(resource, namespace, name)
    if live is None:
        path = resource.path(namespace, name)
        # Not forced: if another writer's object appears between the read and the write, fields in conflict are refused.
        return await client.request("PATCH", path, params={"fieldManager": manager}, body=body, content_type=APPLY)
    refuse_foreign(live, body)
    return await overwrite(client, resource, namespace, body, live=live, manager=manager)


async def overwrite(
    client: Client, resource: Resource, namespace: str, body: Object, *, live: Object, manager: str
) -> Object:
    """Apply over exactly this live object of ours, and not over a later one of the same name.

    Raises ApiError.
    """
    exact = {**body, "metadata": {**body["metadata"], "uid": live["metadata"]["uid"]}}
    return await client.apply(resource, namespace, exact, manager=manager)


async def create(client: Client, resource: Resource, namespace: str, body: Object) -> Object:
    """Create an object, or return the one that an earlier attempt of ours created.

    Raises OwnedByOther if it exists with another controller, and ApiError.
    """
    try:
        return await client.create(resource, namespace, body)
    except ApiError as error:
        if error.reason != "AlreadyExists":
            raise
    live = await client.get(resource, namespace, body["metadata"]["name"])
    refuse_foreign(live, body)
    return live


async def delete_exactly(client: Client, resource: Resource, item: Object) -> None:
    """Delete an object only if nothing has changed it since it was read.

    Another process may claim a pod of a shared pool at that moment, and a claimed pod must not be deleted. Raises
    ApiError, with status 409 if the object has changed.
    """
    metadata = item["metadata"]
    options = {
        "kind": "DeleteOptions",
        "apiVersion": "v1",
        "propagationPolicy": "Background",
        "preconditions": {"uid": metadata["uid"], "resourceVersion": metadata["resourceVersion"]},
    }
    try:
        await client.request("DELETE", resource.path(metadata["namespace"], metadata["name"]), body=options)
    except ApiError as error:
        if not error.not_found:
            raise


def same_controller(live: Object, body: Object) -> bool:
    """Whether the live object has the desired object's controller, or the desired object has none."""
    desired = controller_of(body)
    return desired is None or owned_by(live, desired["uid"])


def _of_nobody(live: Object, body: Object) -> bool:
    """Whether neither object has a controller, and the live object has those of our labels that the desired one has."""
    if controller_of(live) is not None or controller_of(body) is not None:
        return False
    labels = live["metadata"].get("labels") or {}
    wanted = body["metadata"].get("labels") or {}
    return all(labels.get(key) == value for key, value in wanted.items() if key.startswith(f"{GROUP}/"))


def refuse_foreign(live: Object, body: Object) -> None:
    """Raise OwnedByOther if the live object belongs to another owner.

    It is ours if both objects have the same controller, or if neither has one and the live object has our labels.
    """
    if not (_of_nobody(live, body) if controller_of(body) is None else same_controller(live, body)):
        found = controller_of(live)
        owner = f"{found['kind']} {found['name']}" if found else "nobody of ours"
        metadata = live["metadata"]
        raise OwnedByOther(body.get("kind", "object"), metadata.get("namespace", ""), metadata["name"], owner)
