"""`scripts/cluster` with the provider kind, and the names of its nodes."""

from __future__ import annotations

from pathlib import Path

from testcluster import cli
from testcluster.paths import cache

CONTROL_PLANE = "understudy-control-plane"
WORKERS = ["understudy-worker", "understudy-worker2", "understudy-worker3"]
WORKER = WORKERS[0]


def cluster_command(*arguments: str) -> int:
    """Run `scripts/cluster` in this process, and return its exit code."""
    command, *rest = arguments
    return cli.main([command, "--provider", "kind", *rest])


def kubeconfig() -> Path:
    """Return the kubeconfig of the cluster."""
    return cache() / "kind" / "understudy.conf"
