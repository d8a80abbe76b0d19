"""Pods as instances: what a kubelet and a node's loss say of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.failover.interfaces import Instance
from understudy.kube.client import ApiError
from understudy.monitor.act.instances.pod_control import PodControl, instance_of
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import Notices

EVICTION = {"type": "DisruptionTarget", "status": "True", "reason": "DeletionByTaintManager"}
DELETED = {"deletionTimestamp": "2026-01-01T00:00:30Z"}


def pod(metadata: dict[str, Any] | None = None, **status: Any) -> dict[str, Any]:
    containers = [{"name": "drive"}, {"name": names.AGENT_CONTAINER}]
    return {
        "metadata": {"name": "w-1", "uid": "uid-1", **(metadata or {})},
        "spec": {"containers": containers},
        "status": {"phase": "Running", **status},
    }


def container(name: str, reason: str, restarts: int = 3) -> dict[str, Any]:
    return {"name": name, "restartCount": restarts, "state": {"waiting": {"reason": reason}}}


@pytest.mark.parametrize(
    ("status", "crashing"),
    [
        (container("drive", "CrashLoopBackOff"), True),
        (container("drive", "ContainerCreating"), False),
        (container(names.AGENT_CONTAINER, "CrashLoopBackOff"), False),
    ],
)
def test_an_application_that_ends_again_and_again_is_known_by_what_the_kubelet_says(
    status: dict[str, Any], crashing: bool
) -> None:
    found = instance_of(pod(containerStatuses=[status]))
    assert found.crashing is crashing
    assert found.usable


def test_a_pod_that_is_evicted_since_its_node_is_lost_is_not_leaving() -> None:
    found = instance_of(pod(DELETED, conditions=[EVICTION]))
    assert (found.terminating, found.evicted, found.leaving, found.usable) == (True, True, False, False)


@pytest.mark.parametrize("conditions", [[], [{**EVICTION, "reason": "EvictionByEvictionAPI"}]])
def test_a_pod_that_is_deleted_otherwise_is_leaving(conditions: list[dict[str, Any]]) -> None:
    found = instance_of(pod(DELETED, conditions=conditions))
    assert (found.terminating, found.evicted, found.leaving) == (True, False, True)


def test_a_pod_that_stays_is_neither() -> None:
    found = instance_of(pod(conditions=[EVICTION]))
    assert (found.terminating, found.evicted, found.leaving) == (False, False, False)


def test_what_its_status_says_is_known_and_restarts_of_the_agent_are_not_the_application_s() -> None:
    ready = {"type": "Ready", "status": "False", "reason": "ContainersNotReady"}
    found = instance_of(
        pod(
            conditions=[ready, {"type": "PodScheduled", "status": "True"}],
            containerStatuses=[
                container("drive", "", 2),
                container("arm", "", 1),
                container(names.AGENT_CONTAINER, "", 9),
            ],
        )
    )
    assert found.conditions == (("Ready", "False", "ContainersNotReady"), ("PodScheduled", "True", ""))
    assert found.restarts == 3


class Controller(MemoryClient):
    """An API server that answers each request but the first ones, which fail."""

    def __init__(self, *errors: Exception) -> None:
        super().__init__()
        left, self.done = list(errors), list[str]()
        self.failing = lambda method, name: left.pop() if left else None
        self.items["replicasets", "fleet", "w"] = {"metadata": {}, "spec": {}}

    def _note(self, method: str, name: str, body: Any = None) -> None:
        super()._note(method, name, body)
        what = {"PATCH": lambda: f"scale {name} to {body['spec']['replicas']}", "DELETE": lambda: f"delete {name}"}
        self.done.append(what[method]())


def fleet(client: Controller, steps: Path) -> PodControl:
    settings = SimpleNamespace(source_kind="ReplicaSet", source_name="w", pools=())
    view: Any = SimpleNamespace(settings=settings, namespace="fleet", pods_revision=(0, 0), all_pods=lambda: [])
    return PodControl(client, view, CrashPoints(steps), Notices())


@pytest.mark.parametrize(
    "error",
    [ApiError(429, "TooManyRequests", "later"), ApiError(500, "Error", "etcd"), OSError("reset"), TimeoutError()],
)
async def test_a_pod_is_replaced_though_the_api_server_is_busy_for_a_moment(tmp_path: Path, error: Exception) -> None:
    client = Controller(error, error)
    await fleet(client, tmp_path).replace([Instance("w-1", "u1")])
    assert client.done == ["scale w to 1", "delete w-1"]


async def test_a_pod_that_may_not_be_replaced_is_not_asked_for_again(tmp_path: Path) -> None:
    client = Controller(ApiError(403, "Forbidden", "no"))
    with pytest.raises(ApiError, match="Forbidden"):
        await fleet(client, tmp_path).replace([Instance("w-1", "u1")])
    assert client.done == []
