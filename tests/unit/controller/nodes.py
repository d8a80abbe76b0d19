"""Nodes, and waiting pods on them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from tests.unit.controller.pools import present
from tests.unit.controller.world import (
    held_pod,
)
from understudy.controller.pods import pool_pods
from understudy.kube.client import Object


def node(name: str, *, version: int = 5, taint: str = "", **spec: Any) -> Object:
    taints = {"taints": [{"key": taint, "effect": "NoExecute"}]} if taint else {}
    metadata = {"name": name, "uid": f"uid-{name}", "resourceVersion": str(version), "labels": {"zone": "a"}}
    images = [{"names": ["app:1"], "sizeBytes": 1}]
    return {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": metadata,
        "spec": {**spec, **taints},
        "status": {"images": images},
    }


def on(place: str, pod: Object) -> Object:
    return pod | {"spec": {"nodeName": place}}


def held(pool: Object, *places: str, ready: bool = True, prefix: str = "spare") -> list[Object]:
    return [
        on(place, held_pod(f"{prefix}-{number}", of=pool, template_hash=present(pool), ready=ready))
        for number, place in enumerate(places)
    ]


def leaving(observed: pool_pods.Observed, *names: str) -> pool_pods.Observed:
    return replace(observed, leaving=frozenset(names))
