"""Applies patches and formats lists like an API server, for tests that stand in for one."""

from __future__ import annotations

import copy
from typing import Any

from understudy.kube.client import ApiError, Object

COLUMNS = ("Name", "Ready", "Status", "Restarts", "Age", "IP", "Node", "Nominated Node", "Readiness Gates")
"""Columns of a table of pods (Kubernetes 1.34)."""


def json_patched(item: Object, operations: list[Object]) -> Object:
    """Apply a JSON patch (RFC 6902) with tests, additions and removals. Raises ApiError as an API server refuses
    one."""
    made = copy.deepcopy(item)
    for operation in operations:
        *way, last = (key.replace("~1", "/").replace("~0", "~") for key in operation["path"].split("/")[1:])
        parent: Any = made
        for key in way:
            parent = parent.get(key) if isinstance(parent, dict) else None
        if not isinstance(parent, dict) or (operation["op"] != "add" and last not in parent):
            raise ApiError(422, "Invalid", f"{operation['path']} is missing")
        if operation["op"] == "test" and parent[last] != operation["value"]:
            raise ApiError(422, "Invalid", f"{operation['path']} is another")
        if operation["op"] == "remove":
            del parent[last]
        elif operation["op"] == "add":
            parent[last] = copy.deepcopy(operation["value"])
    return made


def tabled(pods: Object) -> Object:
    """Return a list of pods as a table that does not contain the pods themselves."""
    return {
        "kind": "Table",
        "apiVersion": "meta.k8s.io/v1",
        "metadata": pods["metadata"],
        "columnDefinitions": [{"name": name} for name in COLUMNS],
        "rows": [{"cells": _cells(pod), "object": None} for pod in pods["items"]],
    }


def _cells(pod: Object) -> list[object]:
    status = pod.get("status") or {}
    total = len(pod["spec"].get("containers") or [])
    ready = {"type": "Ready", "status": "True"}.items()
    done = total if any(ready <= one.items() for one in status.get("conditions") or []) else 0
    shown = "Terminating" if "deletionTimestamp" in pod["metadata"] else status.get("phase", "Pending")
    node, none = pod["spec"].get("nodeName") or "<none>", "<none>"
    return [pod["metadata"]["name"], f"{done}/{total}", shown, 0, "1s", status.get("podIP") or none, node, none, none]
