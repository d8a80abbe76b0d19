"""Marks objects as Understudy's own."""

from __future__ import annotations

import base64

from understudy.api.base import API_VERSION
from understudy.controller.observed import kube_objects
from understudy.kube import apply
from understudy.kube.client import Object


def ours(body: Object, owner: Object, parent: Object) -> Object:
    """Return an object with its namespace, its owner, and the label with which Understudy finds its objects."""
    made = nobodys(body, parent["metadata"]["namespace"])
    return {**made, "metadata": {**made["metadata"], "ownerReferences": [owner]}}


def nobodys(body: Object, namespace: str) -> Object:
    """Return an object with its namespace and that label, but without an owner, so that only the operator deletes it."""
    metadata = body["metadata"]
    labels = {**(metadata.get("labels") or {}), **kube_objects.MANAGED_BY}
    return {**body, "metadata": {**metadata, "namespace": namespace, "labels": labels}}


def controls(uid: str, item: Object) -> bool:
    """Whether the object with this UID is the item's controller."""
    return apply.owned_by(item, uid)


def is_understudys(item: Object) -> bool:
    """Whether the controller of an object is of one of Understudy's kinds."""
    owner = apply.controller_of(item)
    return owner is not None and owner.get("apiVersion") == API_VERSION


def token(name: str, value: str) -> Object:
    """Return a Secret with the agents' token."""
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "metadata": {"name": name},
        "type": "Opaque",
        "data": {"token": base64.b64encode(value.encode()).decode()},
    }
