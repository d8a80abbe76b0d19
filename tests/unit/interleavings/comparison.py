"""Compares what several monitors report, for tests."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from understudy.kube.client import Client, Object

REPOSITORY = Path(__file__).parents[3]


def observed_alike(module: str, seed: int, others: range) -> str:
    """All that happens by a seed: the same in another process, where sets have another order, and whatever was run in it before."""
    text = f"from tests.unit.interleavings.{module} import run; {{before}}; print(run({seed}, tracing=True))"
    observations = {
        subprocess.run(
            [sys.executable, "-c", text.format(before=before)],
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'operator'}", "PYTHONHASHSEED": order},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for order, before in (("1", "pass"), ("2", f"[run(seed) for seed in {others}]"))
    }
    assert len(observations) == 1
    return observations.pop()


def without(*keys: str) -> Any:
    """A client's patch that loses preconditions."""
    real = Client.patch

    async def patch(self: Client, resource: Any, namespace: Any, name: str, body: Any, **more: Any) -> Object:
        if isinstance(body, list):
            body = [operation for operation in body if operation["op"] != "test"]
            return await real(self, resource, namespace, name, body, **more)
        metadata = {key: value for key, value in (body.get("metadata") or {}).items() if key not in keys}
        return await real(self, resource, namespace, name, {**body, "metadata": metadata}, **more)

    return patch


def unconditional(patch_of: Callable[..., Object]) -> Callable[..., Object]:
    """What makes a patch of a gate, without the version of the object that the patch requires."""

    def careless(workload: str, **more: Any) -> Object:
        patch = patch_of(workload, **more)
        del patch["metadata"]["resourceVersion"]
        return patch

    return careless
