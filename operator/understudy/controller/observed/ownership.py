"""Marks objects as Understudy's own."""

from __future__ import annotations

import base64
from collections.abc import Callable

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.api.protocol import monitor_key
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


def agent_secret(name: str, random: Callable[[], str], *, keyed: bool) -> Object:
    """Return a Secret with a token for agents, and with the keys of their monitor if ``keyed``."""
    made: Object = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": name}, "type": "Opaque"}
    keys = _monitor_keys(random()) if keyed else {"metadata": {}, "data": {}}
    data = {names.TOKEN: base64.b64encode(random().encode()).decode(), **keys["data"]}
    return made | {"metadata": made["metadata"] | keys["metadata"], "data": data}


def corrected_keys(secret: Object, random: Callable[[], str], *, keyed: bool) -> Object | None:
    """Return the merge patch that gives the keys of the monitor to an agents' Secret, or removes them; None if nothing differs."""
    if keyed == (names.MONITOR_KEYS in (secret["metadata"].get("annotations") or {})):
        return None
    if keyed:
        return _monitor_keys(random())
    without = dict.fromkeys((names.MONITOR_PRIVATE_KEY, names.MONITOR_PUBLIC_KEY))
    return {"metadata": {"annotations": {names.MONITOR_KEYS: None}}, "data": without}


def _monitor_keys(seed: str) -> Object:
    private, public = monitor_key.pair(seed)
    data = {names.MONITOR_PRIVATE_KEY: private, names.MONITOR_PUBLIC_KEY: public}
    encoded = {entry: base64.b64encode(value).decode() for entry, value in data.items()}
    return {"metadata": {"annotations": {names.MONITOR_KEYS: "X25519"}}, "data": encoded}
