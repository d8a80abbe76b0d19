"""Labels that somebody changed are restored while the workload's own reconciliation waits, for example for a webhook."""

from __future__ import annotations

import asyncio
import copy
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.unit.controller import world
from tests.unit.controller.world import NAMESPACE, claimed_pod, held_pod, hot, policy, source_pod, spare, standby_pod
from tests.unit.kube.memory import MemoryClient, merge
from understudy.api import names
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.runtime.workers import Operator
from understudy.kube.client import PODS, POLICIES, POOLS, WORKLOADS, Object, Part, Resource
from understudy.kube.events import Recorder

W = world.workload()
OTHERS: Object = {names.WORKLOAD: None, names.COMPONENT: None, names.INSTANCE: None, names.POOL: None}


class Unanswered(MemoryClient):
    """An API server that answers no request to create or apply an object, because a webhook does not answer it."""

    def __init__(self) -> None:
        super().__init__()
        self.waits = asyncio.Event()

    async def create(self, *_: Any, **__: Any) -> Object:
        return await self._wait()

    async def request(self, *_: Any, **__: Any) -> Object:
        return await self._wait()

    async def _wait(self) -> Object:
        self.waits.set()
        return await asyncio.Future[Object]()

    async def parts(
        self, resource: Resource, namespace: str | None = None, *, labels: str | None = None
    ) -> AsyncIterator[Part]:
        answer = await self.list(resource, namespace, labels=labels)
        head = {"apiVersion": "v1", "kind": "List", "metadata": answer["metadata"]}
        yield Part(head, json.dumps(answer["items"])[1:-1].encode())


class Scene:
    """An operator that leads, with one workload, whose reconciliation waits."""

    def __init__(self, *pods: Object) -> None:
        self.client, self.store = Unanswered(), Store()
        for resource, item in ((WORKLOADS, W), (POLICIES, policy("hot")), (POOLS, hot()), *((PODS, p) for p in pods)):
            self.store.put(resource, self.client.store(resource, NAMESPACE, copy.deepcopy(item)))
        expectations = Expectations()
        reconciler = Reconciler(
            self.client,
            self.store,
            Observer(self.client, self.store, expectations),
            Executor(self.client, self.store, expectations, may_write=lambda: True),
            Recorder(self.client, "test", "test"),
            world.IMAGES,
            Rollouts(self.store),
        )
        self.operator = Operator(self.client, self.store, reconciler, namespaces=[NAMESPACE], resync_every=30.0)

    @asynccontextmanager
    async def waiting(self) -> AsyncIterator[None]:
        """Lead, from the time at which the workload's reconciliation waits."""
        leading = asyncio.create_task(self.operator.lead())
        try:
            async with asyncio.timeout(10):
                await self.client.waits.wait()
            yield
        finally:
            leading.cancel()
            await asyncio.gather(leading, return_exceptions=True)
            self.operator.queue.close()

    def labels(self, name: str) -> dict[str, str]:
        found: dict[str, str] = self.client.items[PODS.plural, NAMESPACE, name]["metadata"]["labels"]
        return found

    def change(self, name: str, labels: Object) -> None:
        """Have somebody change these labels of a pod, and the watch report it."""
        pod = copy.deepcopy(self.client.items[PODS.plural, NAMESPACE, name])
        merge(pod, {"metadata": {"labels": labels}})
        self.operator.see(PODS, self.client.store(PODS, NAMESPACE, pod), False)


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("w-s", {names.INSTANCE: "w-a"}),
        ("w-s", {names.WORKLOAD: None}),
        ("w-s", {names.WORKLOAD: "other"}),
        ("w-s", {names.COMPONENT: None}),
        ("w-s", {names.POOL: None}),
        ("w-s", OTHERS),
        ("w-a", {names.INSTANCE: "w-s"}),
    ],
    ids=["instance", "workload", "other-workload", "component", "pool", "all", "instance-of-source"],
)
async def test_labels_are_restored_although_the_workloads_reconciliation_waits(name: str, labels: Object) -> None:
    scene = Scene(source_pod("w-a"), standby_pod("w-s", of=W))
    before = dict(scene.labels(name))
    async with scene.waiting():
        for _ in range(2):
            scene.change(name, labels)
            assert scene.labels(name) != before
            async with asyncio.timeout(5):
                while scene.labels(name) != before:
                    await asyncio.sleep(0.005)


def _change(old: Object | None, labels: Object, **metadata: Any) -> ObservedChange:
    new = copy.deepcopy(old) if old is not None else standby_pod("w-s", of=W)
    merge(new, {"metadata": {"labels": labels, **metadata}})
    return ObservedChange(PODS, old, new)


def test_only_changed_labels_of_an_instance_are_restored_apart() -> None:
    standby = standby_pod("w-s", of=W)
    tampered = _change(standby, {names.POOL: None})
    assert change_index.tampered(tampered) == Key(PODS.plural, NAMESPACE, "w-s")
    held = held_pod("spare-1", of=spare())
    for change in (
        _change(standby, {}, annotations={"note": "a"}),
        _change(None, {names.POOL: None}),
        _change(standby, {names.POOL: None}, deletionTimestamp="2026-01-01T00:00:00Z"),
        _change(standby, {names.POOL: None}, uid="another"),
        _change(source_pod("w-a"), {"team": "b"}),
        ObservedChange(PODS, held, claimed_pod("spare-1", of=spare(), by=W)),
        ObservedChange(PODS, standby, None),
        ObservedChange(WORKLOADS, W, W),
    ):
        assert change_index.tampered(change) is None, change
