"""An admission webhook that must be called and does not answer is reported, and the request is tried again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.clock import MonotonicClock
from tests.unit.controller import world
from tests.unit.kube.memory import MemoryClient
from understudy.controller.reconcile import reconciler as reconciling
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.kube.client import PODS, POLICIES, POOLS, WORKLOADS, ApiError, Object
from understudy.kube.events import Recorder

WEBHOOK = "validate.policies.example"
CAUSES = (
    'Post "https://policies.example.svc:443/?timeout=10s": dial tcp 10.96.0.7:443: connect: connection refused',
    'Post "https://policies.example.svc:443/?timeout=10s": context deadline exceeded',
)


class Guarded(MemoryClient):
    """An API server that asks a webhook about all that is written but a status."""

    def __init__(self, *stored: Object) -> None:
        super().__init__()
        self.stored = stored
        self.written: list[Object] = []
        self.words = self._words()

    def _words(self) -> Iterator[str]:
        while True:
            for cause in CAUSES:
                yield f'Internal error occurred: failed calling webhook "{WEBHOOK}": failed to call webhook: {cause}'

    def refuse(self, *_: Any) -> ApiError:
        return ApiError(500, "InternalError", next(self.words))

    async def request(self, method: str, path: str, *, body: Any = None, **_: Any) -> Any:
        if not path.endswith("/status"):
            raise self.refuse()
        self.written.append(body)
        item = next(item for item in self.stored if item["metadata"]["name"] == body["metadata"]["name"])
        metadata = {**item["metadata"], "resourceVersion": str(1000 + len(self.written))}
        return {**item, "metadata": metadata, "status": body["status"]}


class RecordedWarnings(Recorder):
    def __init__(self) -> None:
        self.warnings: list[tuple[str, str]] = []

    async def normal(self, item: Object, reason: str, message: str) -> None:
        return

    async def warning(self, item: Object, reason: str, message: str) -> None:
        self.warnings.append((reason, message))


def reconciling_with(client: Guarded, notices: RecordedWarnings) -> tuple[Reconciler, Store]:
    """A reconciler that knows what is stored, and where it knows it from."""
    store, expectations = Store(), Expectations()
    for resource, found in (
        *((WORKLOADS if item["kind"] == "RobotWorkload" else POOLS, item) for item in client.stored),
        (POLICIES, world.policy("spare")),
    ):
        store.put(resource, found)
    reconciler = Reconciler(
        client, store, Observer(client, store, expectations), Executor(client, store, expectations, may_write=lambda: True),
        notices, world.IMAGES, Rollouts(store),
    )  # fmt: skip
    return reconciler, store


@pytest.mark.parametrize("plural", ["robotworkloads", "fallbackpools"])
@pytest.mark.parametrize("refused", ["all", "dry run"])
async def test_an_unanswered_webhook_is_reported_once_and_the_request_is_retried(plural: str, refused: str) -> None:
    item, pool = world.workload(), world.spare()
    client, notices = Guarded(item, pool), RecordedWarnings()
    if refused == "dry run":
        client.failing = lambda method, _: client.refuse() if method == "POST" else None
    reconciler, _ = reconciling_with(client, notices)
    key = Key(plural, item["metadata"]["namespace"], "w" if plural == "robotworkloads" else "spare")
    for _ in range(3):
        with pytest.raises(ApiError, match="failed calling webhook"):  # so it is tried again, later each time
            await reconciler.reconcile(key)
    assert len(client.written) == 1, "what it fails by differs, and isn't news"
    conditions = {one["type"]: one for one in client.written[0]["status"]["conditions"]}
    assert (conditions["Reconciled"]["status"], conditions["Reconciled"]["reason"]) == ("False", "WebhookUnavailable")
    assert f'"{WEBHOOK}" does not answer' in conditions["Reconciled"]["message"]
    assert conditions["Accepted"]["status"] == "True", "that says nothing of its spec"
    assert [reason for reason, _ in notices.warnings].count("WebhookUnavailable") == 1


async def test_claims_during_a_webhook_failure_update_the_status_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    pool = world.spare(replicas=3)
    client = Guarded(pool)
    reconciler, store = reconciling_with(client, RecordedWarnings())
    clock = MonotonicClock()
    monkeypatch.setattr(reconciling, "time", clock)
    key = Key("fallbackpools", world.NAMESPACE, "spare")
    for number in range(4):
        store.put(PODS, world.held_pod(f"spare-{number}", of=pool, template_hash="x"))
        with pytest.raises(ApiError, match="failed calling webhook"):
            await reconciler.reconcile(key)
        clock.now += 0.1
    assert [body["status"]["replicas"] for body in client.written] == [1]
    clock.now += 1.0
    with pytest.raises(ApiError, match="failed calling webhook"):  # as each failure is tried again
        await reconciler.reconcile(key)
    assert [body["status"]["replicas"] for body in client.written] == [1, 4]
