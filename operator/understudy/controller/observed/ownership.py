"""What marks an object as ours."""

from __future__ import annotations

import base64

from understudy.controller.observed import kube_objects
from understudy.kube import apply
from understudy.kube.client import Object


def ours(body: Object, owner: Object, parent: Object) -> Object:
    """An object with its namespace, its owner and the label by which all of ours are found."""
    made = nobodys(body, parent["metadata"]["namespace"])
    return {**made, "metadata": {**made["metadata"], "ownerReferences": [owner]}}


def nobodys(body: Object, namespace: str) -> Object:
    """The same without an owner: nothing but the operator deletes it."""
    metadata = body["metadata"]
    labels = {**(metadata.get("labels") or {}), **kube_objects.MANAGED_BY}
    return {**body, "metadata": {**metadata, "namespace": namespace, "labels": labels}}


def controls(uid: str, item: Object) -> bool:
    """Whether the object with that UID is the item's controller."""
    return apply.owned_by(item, uid)


def token(name: str, value: str) -> Object:
    """A Secret with the token of agents."""
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "metadata": {"name": name},
        "type": "Opaque",
        "data": {"token": base64.b64encode(value.encode()).decode()},
    }
