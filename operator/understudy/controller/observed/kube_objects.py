"""Functions that read Kubernetes objects as plain dictionaries."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from datetime import datetime

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.api.conditions import Condition
from understudy.kube.client import EVICTION, Object

MANAGED_BY = {"app.kubernetes.io/managed-by": "understudy"}
"""Label of every object that the operator creates, so that one list per resource finds them all."""


def name(item: Object) -> str:
    """Return the object's name."""
    text: str = item["metadata"]["name"]
    return text


def uid(item: Object) -> str:
    """Return the object's UID."""
    text: str = item["metadata"].get("uid", "")
    return text


def labels(item: Object) -> dict[str, str]:
    """Return the object's labels."""
    return item["metadata"].get("labels") or {}


def notes(item: Object) -> dict[str, str]:
    """Return the object's annotations."""
    return item["metadata"].get("annotations") or {}


def status(item: Object, conditions: Iterable[Condition]) -> Object:
    """Return the status of an object with these conditions. They are about the present generation of its spec, unless
    they name another one."""
    generation = item["metadata"].get("generation")
    present = {"observedGeneration": generation} if generation is not None else {}
    return {"observedGeneration": generation, "conditions": [present | one.to_wire() for one in conditions]}


def deleted(item: Object) -> bool:
    """Whether the object is being deleted."""
    return bool(item["metadata"].get("deletionTimestamp"))


def owner(kind: str, item: Object) -> Object:
    """Return the owner reference for objects that a RobotWorkload or FallbackPool controls.

    It never blocks the owner's deletion.
    """
    return {
        "apiVersion": API_VERSION,
        "kind": kind,
        "name": name(item),
        "uid": uid(item),
        "controller": True,
        "blockOwnerDeletion": False,
    }


def alive(pod: Object) -> bool:
    """Whether a pod counts: it is not being deleted and has not ended."""
    return not deleted(pod) and (pod.get("status") or {}).get("phase") not in ("Failed", "Succeeded")


def ended(pod: Object) -> bool:
    """Whether a pod has ended permanently, for example by eviction, and only remains as a record."""
    return not deleted(pod) and (pod.get("status") or {}).get("phase") in ("Failed", "Succeeded")


def evicted(pod: Object) -> bool:
    """Whether a pod is being deleted because its node is lost. Its processes may live on."""
    conditions = (pod.get("status") or {}).get("conditions") or []
    return deleted(pod) and any((c["type"], c.get("reason")) == ("DisruptionTarget", EVICTION) for c in conditions)


def ready(pod: Object) -> bool:
    """Whether a pod is alive and Ready."""
    conditions = (pod.get("status") or {}).get("conditions") or []
    return alive(pod) and any(c["type"] == "Ready" and c["status"] == "True" for c in conditions)


def created(item: Object) -> float:
    """Return when the object was created, in Unix seconds; 0 if unknown."""
    text = item["metadata"].get("creationTimestamp")
    return datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp() if text else 0.0


def sort_key(item: Object) -> tuple[float, str]:
    """Return a sort key: oldest first, and always in the same order."""
    return created(item), name(item)


def active(gate: Object | None) -> tuple[str, str]:
    """Return name and UID of the active pod from a gate's annotations; empty while the gate is closed or missing."""
    found = notes(gate) if gate is not None else {}
    return found.get(names.ACTIVE, ""), found.get(names.ACTIVE_UID, "")


def is_active(pod: Object, gate: Object | None) -> bool:
    """Whether a pod is the active one."""
    return bool(uid(pod)) and active(gate)[1] == uid(pod)


def hint(found: str, known: Iterable[str]) -> str:
    """Return a suggestion of the intended name, for the end of a message."""
    candidates = sorted(known)
    close = difflib.get_close_matches(found, candidates, n=1)
    if close:
        return f'did you mean "{close[0]}"?'
    if candidates:
        shown = ", ".join(candidates[:5]) + (", ..." if len(candidates) > 5 else "")
        return f"there are: {shown}"
    return "there is none in this namespace"
