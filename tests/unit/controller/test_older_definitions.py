"""A definition that is older than the operator, as where the chart was upgraded with crds.install false."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller import world
from tests.unit.kube.memory import MemoryClient
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.kube.client import POLICIES, ApiError, Object
from understudy.kube.events import Recorder


class Older(MemoryClient):
    """An API server whose FailurePolicy lacks observedGeneration."""

    def __init__(self, item: Object) -> None:
        super().__init__()
        self.item = item
        self.statuses: list[Object] = []

    async def request(self, method: str, path: str, *, body: Any = None, **_: Any) -> Any:
        if not path.endswith("/status"):
            return {}
        if "observedGeneration" in body["status"]:
            message = "failed to create typed patch object (fleet/policy): .status.observedGeneration: field not declared in schema"
            raise ApiError(500, "InternalError", message)
        self.statuses.append(body["status"])
        return {**self.item, "status": body["status"]}


async def test_known_status_fields_are_written_and_missing_ones_are_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    item = world.policy("Restart")
    client, store, expectations = Older(item), Store(), Expectations()
    store.put(POLICIES, item)
    reconciler = Reconciler(
        client, store, Observer(client, store, expectations), Executor(client, store, expectations, may_write=lambda: True),
        Recorder(client, "understudy", "x"), world.IMAGES, Rollouts(store),
    )  # fmt: skip
    for _ in range(2):
        await reconciler.reconcile(Key("failurepolicies", item["metadata"]["namespace"], "policy"))
    assert [one["type"] for one in client.statuses[-1]["conditions"]] == ["Ready", "Accepted"]
    (warning,) = (record.message for record in caplog.records if "is older than this operator" in record.message)
    assert "lacks .status.observedGeneration" in warning
