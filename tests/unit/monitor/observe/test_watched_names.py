"""What a monitor watches of its namespace: by name what it may read by name, and who waits only where it could wait too."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from understudy.api import names
from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.kube.api_contact import ApiContact
from understudy.kube.client import (
    CONFIG_MAPS,
    NETWORK_POLICIES,
    POLICIES,
    WORKLOADS,
    ApiError,
    Client,
    Object,
    Resource,
)
from understudy.monitor.observe.objects import cluster_view as viewing
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

Watch = tuple[str, str | None, str | None]
"""Resource, labels and fields of a watch."""


class Server(Client):
    """Keeps objects and brings what changes to who watches them; refuses what it's told to."""

    def __init__(self) -> None:
        self.contact = ApiContact()
        self.items: dict[tuple[str, str], Object] = {}
        self.open: list[tuple[Watch, asyncio.Queue[tuple[str, Object]]]] = []
        self.refused: set[str | None] = set()
        self._version = 1

    @property
    def watched(self) -> set[Watch]:
        return {watch for watch, _ in self.open}

    def put(self, resource: Resource, name: str, item: Object) -> None:
        self._version += 1
        metadata = {"name": name, "uid": f"uid-{name}", "resourceVersion": str(self._version)}
        kind = "MODIFIED" if (resource.plural, name) in self.items else "ADDED"
        self.items[resource.plural, name] = made = {"metadata": metadata, **item}
        for (plural, _, fields), queue in self.open:
            if plural == resource.plural and fields in (None, f"metadata.name={name}"):
                queue.put_nowait((kind, made))

    async def list(self, resource: Resource, namespace: str | None, *, fields: str | None = None, **_: Any) -> Object:
        if fields in self.refused:
            raise ApiError(403, "Forbidden", f"{resource.plural} with {fields}")
        found = [
            item
            for (plural, name), item in self.items.items()
            if plural == resource.plural and fields in (None, f"metadata.name={name}")
        ]
        return {"metadata": {"resourceVersion": str(self._version)}, "items": found}

    async def watch(
        self,
        resource: Resource,
        namespace: str | None,
        *,
        version: str,
        labels: str | None = None,
        fields: str | None = None,
    ) -> AsyncIterator[tuple[str, Object]]:
        entry = (resource.plural, labels, fields), asyncio.Queue[tuple[str, Object]]()
        self.open.append(entry)
        try:
            while True:
                yield await entry[1].get()
        finally:
            self.open.remove(entry)


def refer(server: Server, policy: str) -> None:
    outputs = [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}]
    spec = {"template": {"spec": {}}, "outputs": outputs, "failurePolicyRef": {"name": policy}}
    server.put(WORKLOADS, "w", {"spec": spec})


def give_policy(server: Server, name: str, gap: str) -> None:
    tree = {"topic": {"name": "/cmd_vel", "gap": gap}}
    server.put(POLICIES, name, {"spec": {"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart"}]}})


def give_pools(server: Server, *pools: Readiness) -> None:
    settings = WorkloadSettings(
        workload="w",
        namespace="fleet",
        uid="u",
        source_kind="ReplicaSet",
        source_name="w",
        pools=[PoolChoice(name=f"pool-{index}", readiness=readiness) for index, readiness in enumerate(pools)],
    )
    server.put(CONFIG_MAPS, names.settings("w"), {"data": {"settings.json": settings.model_dump_json(by_alias=True)}})


def gap(view: ClusterView) -> str | None:
    """The name that distinguishes the policies of these tests."""
    return view.policy.monitoring.yaml["topic"]["gap"] if view.policy and view.policy.monitoring.yaml else None


def policies_watched(server: Server) -> set[str | None]:
    return {fields for plural, _, fields in server.watched if plural == POLICIES.plural}


WHO_WAITS: Watch = (NETWORK_POLICIES.plural, names.WAITS_FOR, None)


@pytest.fixture
def server() -> Server:
    found = Server()
    refer(found, "p")
    give_policy(found, "p", "500ms")
    give_policy(found, "q", "2s")
    give_pools(found, "Executing")
    return found


@contextlib.asynccontextmanager
async def viewed(server: Server) -> AsyncIterator[ClusterView]:
    """A monitor's copies, until the end of the block."""

    class Over(Exception):
        pass

    with contextlib.suppress(Over):
        try:
            async with asyncio.TaskGroup() as group:
                view = ClusterView(server, "fleet", "w", Wakeups())
                await view.run(group)
                await settled()
                yield view
                raise Over
        except ExceptionGroup as errors:
            (error,) = errors.exceptions
            raise error from None


async def settled() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


async def test_only_the_policy_of_the_workload_is_watched(server: Server) -> None:
    async with viewed(server) as view:
        assert policies_watched(server) == {"metadata.name=p"}
        assert gap(view) == "500ms"
        give_policy(server, "p", "700ms")
        await settled()
        assert gap(view) == "700ms"


async def test_a_changed_reference_to_a_policy_is_followed_at_once(server: Server) -> None:
    async with viewed(server) as view:
        refer(server, "q")
        await settled()
        assert policies_watched(server) == {"metadata.name=q"}
        assert gap(view) == "2s"


async def test_the_former_policy_stays_in_force_until_the_next_one_may_be_read(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("understudy.kube.watched_collection.RETRY_FIRST", 0.01)
    server.refused.add("metadata.name=q")
    async with viewed(server) as view:
        refer(server, "q")
        await settled()
        assert gap(view) == "500ms"
        server.refused.clear()
        async with asyncio.timeout(5):
            await view.policies.synced.wait()
        assert gap(view) == "2s"


async def test_a_monitor_starts_without_an_unreadable_policy_and_uses_it_later(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("understudy.kube.watched_collection.RETRY_FIRST", 0.01)
    server.refused.add("metadata.name=p")
    monkeypatch.setattr(viewing, "POLICY_WITHIN", 0.05)
    async with viewed(server) as view:
        assert view.policy is None
        server.refused.clear()
        async with asyncio.timeout(5):
            await view.policies.synced.wait()
        assert gap(view) == "500ms"


async def test_a_starting_monitor_waits_for_its_policy(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("understudy.kube.watched_collection.RETRY_FIRST", 0.01)
    server.refused.add("metadata.name=p")
    asyncio.get_running_loop().call_later(0.1, server.refused.clear)
    async with viewed(server) as view:
        assert gap(view) == "500ms"


async def test_waiting_workloads_are_watched_only_if_there_is_a_pool_to_claim_from(server: Server) -> None:
    async with viewed(server):
        assert WHO_WAITS not in server.watched
        give_pools(server, "Executing", "Uninitialized")
        await settled()
        assert WHO_WAITS in server.watched
        give_pools(server, "Uninitialized")
        await settled()
        assert [watch for watch, _ in server.open].count(WHO_WAITS) == 1
        give_pools(server, "Initialized")
        await settled()
        assert WHO_WAITS not in server.watched
