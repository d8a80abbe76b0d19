"""Objects that several tests of the operator create."""

from __future__ import annotations

from tests.cluster.operators import (
    APPS,
    template,
)
from tests.support.cluster import Object

OURS = "app.kubernetes.io/managed-by=understudy"


def deployment(name: str = "nav2", replicas: int = 1) -> Object:
    pods = template()
    pods["metadata"]["labels"] = {"app": name}
    spec = {"replicas": replicas, "selector": {"matchLabels": {"app": name}}, "template": pods}
    return {"apiVersion": APPS, "kind": "Deployment", "metadata": {"name": name}, "spec": spec}


def identities(items: list[Object]) -> set[str]:
    return {item["metadata"]["uid"] for item in items}
