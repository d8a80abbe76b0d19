"""The operator warns before Cilium's policy maps are full: beyond their limit, the network lets everything through."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from tests.support.cilium import EACH, identity, policies
from tests.support.golden import assert_golden
from tests.unit.controller.world import IMAGES, NAMESPACE, World, pod, policy, workload
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.controller.reconcile import operator_metrics, policy_maps
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.policy_maps import PolicyMaps
from understudy.controller.reconcile.reconciler import WITHDRAWN, Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.runtime.workers import Operator
from understudy.controller.status import workload_status
from understudy.kube.client import (
    CONFIG_MAPS,
    NETWORK_POLICIES,
    PODS,
    WORKLOADS,
    ApiError,
    Client,
    Object,
    Part,
    Resource,
)
from understudy.kube.events import Recorder
from understudy.kube.gates import cilium
from understudy.kube.gates.cilium import PolicyMapUse, Settings

NO_CILIUM = ApiError(404, "NotFound", "the server could not find the requested resource")
FORBIDDEN = ApiError(403, "Forbidden", "not allowed")
BUSY = ApiError(429, "TooManyRequests", "try again")


class Cluster:
    """The objects of Cilium that an API server has; errors are raised."""

    def __init__(self, pods: int = 0) -> None:
        self.identities: list[Object] | ApiError = [identity(number) for number in range(pods)]
        self.settings: dict[str, str] | ApiError | None = {}
        self.asked: list[str] = []

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        assert (resource, namespace, name) == (CONFIG_MAPS, "kube-system", "cilium-config")
        self.asked.append(resource.plural)
        if isinstance(self.settings, ApiError):
            raise self.settings
        return {"data": self.settings} if self.settings is not None else None

    async def parts(self, resource: Resource, namespace: str | None = None) -> AsyncIterator[Part]:
        assert (resource, namespace) == (cilium.IDENTITIES, None)
        self.asked.append(resource.plural)
        if isinstance(self.identities, ApiError):
            raise self.identities
        for begin in range(0, len(self.identities), 100):
            items = self.identities[begin : begin + 100]
            answer = {"kind": "CiliumIdentityList", "apiVersion": "cilium.io/v2", "metadata": {}, "items": items}
            yield Part.of(json.dumps(answer, separators=(",", ":")).encode())


class Scene:
    """A workload whose gate is in the network, and what the operator knows of Cilium."""

    def __init__(self, pods: int = 0, **gate: Any) -> None:
        self.cluster, self.store = Cluster(pods), Store()
        self.store.put(WORKLOADS, workload("w", gate=gate))
        for one in policies(name="w"):
            self.store.put(NETWORK_POLICIES, {**one, "metadata": {**one["metadata"], "namespace": NAMESPACE}})
        self.maps = PolicyMaps(self.cluster, self.store)
        self.changed: list[Key] = []
        self.maps.changed = self.changed.append

    async def low(self) -> PolicyMapUse | None:
        """Look, and return what the workload needs if there is little room."""
        await self.maps.refresh()
        return self.maps.low(NAMESPACE, "w")

    @property
    def metric(self) -> float | None:
        of = {"namespace": NAMESPACE, "workload": "w"}
        return operator_metrics.REGISTRY.get_sample_value("understudy_policy_map_used_ratio", of)


def conditions(use: PolicyMapUse | None) -> list[Object]:
    world = World(workload(), policy("Restart"))
    world.policy_map = use
    return [one for one in world.status()["conditions"] if one["type"] == "PolicyMapSufficient"]


@pytest.mark.parametrize(
    ("pods", "is_low", "is_exceeded"), [(150, False, False), (200, True, False), (261, True, True)]
)
async def test_the_peers_of_a_gate_are_compared_with_the_policy_map(pods: int, is_low: bool, is_exceeded: bool) -> None:
    scene = Scene(pods)
    found = await scene.low()
    assert (found is not None, found is not None and found.is_exceeded) == (is_low, is_exceeded)
    assert scene.metric == pytest.approx(pods * EACH / 16384)


async def test_a_larger_map_has_room_for_more() -> None:
    scene = Scene(261)
    scene.cluster.settings = {"bpf-policy-map-max": "65536"}
    assert await scene.low() is None


@pytest.mark.parametrize("refusal", [NO_CILIUM, FORBIDDEN])
async def test_nothing_is_known_without_cilium_or_without_the_right_to_see_it(refusal: ApiError) -> None:
    scene = Scene(261)
    assert await scene.low() is not None
    scene.cluster.identities = refusal
    assert await scene.low() is None
    assert scene.metric is None
    assert scene.cluster.asked[2:] == ["ciliumidentities"]


async def test_a_fleet_with_muxes_asks_nothing() -> None:
    scene = Scene(261, kind="Mux")
    assert await scene.low() is None
    assert scene.cluster.asked == []


@pytest.mark.parametrize("settings", [FORBIDDEN, None])
async def test_the_default_is_assumed_and_said_if_the_settings_cannot_be_read(settings: ApiError | None) -> None:
    scene = Scene(261)
    scene.cluster.settings = settings
    found = await scene.low()
    assert found is not None
    assert found.settings == cilium.UNREADABLE


async def test_the_last_result_stays_while_the_api_server_does_not_answer() -> None:
    scene = Scene(261)
    before = await scene.low()
    assert before is not None
    for part in ("identities", "settings"):
        setattr(scene.cluster, part, BUSY)
        with pytest.raises(ApiError):
            await scene.maps.refresh()
        assert scene.maps.low(NAMESPACE, "w") == before


async def test_only_workloads_of_which_something_else_is_reported_are_reconciled() -> None:
    scene, key = Scene(150), Key(WORKLOADS.plural, NAMESPACE, "w")
    for pods, times in ((150, 0), (151, 0), (200, 1), (200, 1), (261, 2), (150, 3)):
        scene.cluster.identities = [identity(number) for number in range(pods)]
        await scene.maps.refresh()
        assert scene.changed == [key] * times


async def test_a_condition_stays_until_the_first_look_of_a_new_leader() -> None:
    """Else each change of the leader would remove it, and report it again with an Event."""
    (reported,) = conditions(PolicyMapUse(16443, EACH, Settings()))
    world = World(workload("w", status={"conditions": [reported]}), policy("Restart"))
    world.policy_map_known = False
    assert reported["reason"] in [one["reason"] for one in world.status()["conditions"]]
    scene, key = Scene(0), Key(WORKLOADS.plural, NAMESPACE, "w")
    assert not scene.maps.known
    scene.store.put(WORKLOADS, world.workload | {"metadata": {**world.workload["metadata"], "resourceVersion": "11"}})
    await scene.maps.refresh()
    assert (scene.maps.known, scene.changed) == (True, [key])
    await scene.maps.refresh()
    assert scene.changed == [key]


async def test_nothing_is_reported_of_a_workload_that_was_deleted() -> None:
    scene = Scene(261)
    await scene.low()
    scene.store.remove(WORKLOADS, workload("w"))
    assert await scene.low() is None
    assert scene.metric is None


async def test_new_pods_are_counted_before_the_period_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_maps, "EVERY", 60.0)
    monkeypatch.setattr(policy_maps, "SOONEST", 0.01)
    scene = Scene(150)
    running = asyncio.create_task(scene.maps.run())
    try:
        async with asyncio.timeout(10):
            while scene.metric is None:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.1)
            assert scene.cluster.asked.count("ciliumidentities") == 1
            scene.cluster.identities = [identity(number) for number in range(261)]
            scene.store.put(PODS, pod("new", labels={names.WORKLOAD: "w"}))
            while scene.maps.low(NAMESPACE, "w") is None:
                await asyncio.sleep(0.01)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_an_unexpected_error_does_not_end_the_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_maps, "EVERY", 0.0)
    monkeypatch.setattr(policy_maps, "SOONEST", 0.01)
    scene = Scene(1)
    scene.cluster.identities = cast(Any, [{"security-labels": 7}])
    running = asyncio.create_task(scene.maps.run())
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(asyncio.shield(running), 0.1)
    assert not running.done()
    assert scene.cluster.asked.count("ciliumidentities") > 1
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_enough_room_needs_no_condition() -> None:
    assert conditions(None) == []
    assert "PolicyMapSufficient" in WITHDRAWN


@pytest.mark.parametrize(
    ("needed", "settings", "reason", "facts"),
    [
        (12600, Settings(), "PolicyMapNearlyFull", ("77 %", "16384")),
        (16443, Settings(), "PolicyMapFull", ("101 %", "several instances may drive a robot")),
        (16443, Settings(closes=True), "PolicyMapFull", ("closes the gate of everybody",)),
        (12600, cilium.UNREADABLE, "PolicyMapNearlyFull", ("assumed", "kube-system/cilium-config")),
        (12600, Settings.of({"bpf-policy-map-max": "many"}), "PolicyMapNearlyFull", ("assumed", "'many'")),
    ],
)
def test_too_little_room_is_a_condition(needed: int, settings: Settings, reason: str, facts: tuple[str, ...]) -> None:
    (found,) = conditions(PolicyMapUse(needed, EACH, settings))
    assert (found["status"], found["reason"]) == ("False", reason)
    assert_golden("operator", found["message"], "spec.gate.peers", *facts)


def test_too_little_room_and_its_increase_cause_an_event_each() -> None:
    nearly, more, full = ({"conditions": conditions(PolicyMapUse(n, EACH, Settings()))} for n in (12600, 14000, 16443))
    for before, after, count in (({}, nearly, 1), (nearly, more, 0), (more, full, 1)):
        assert len(workload_status.transitions({"status": before}, after)) == count


class AtRest(MemoryClient):
    """An API server without objects."""

    async def parts(self, *_: Any, **__: Any) -> AsyncIterator[Part]:
        yield Part({"apiVersion": "v1", "kind": "List", "metadata": {"resourceVersion": "1"}}, b"")


async def test_the_leader_looks_and_reconciles_the_workload_with_what_it_found() -> None:
    scene, client, expectations = Scene(261), AtRest(), Expectations()
    observer = Observer(cast(Client, client), scene.store, expectations, scene.maps)
    reconciler = Reconciler(
        client,
        scene.store,
        observer,
        Executor(client, scene.store, expectations, may_write=lambda: True),
        Recorder(client, "test", "test"),
        IMAGES,
        Rollouts(scene.store),
    )
    seen: asyncio.Queue[tuple[Key, PolicyMapUse | None]] = asyncio.Queue()

    async def reconcile(key: Key) -> None:
        found = scene.store.get(WORKLOADS, NAMESPACE, "w")
        assert found is not None
        seen.put_nowait((key, (await observer.workload(found)).policy_map))

    reconciler.reconcile = reconcile  # type: ignore[method-assign, assignment]
    operator = Operator(
        client, scene.store, reconciler, namespaces=[NAMESPACE], resync_every=30.0, policy_maps=scene.maps
    )

    async def listed(**_: Any) -> None:
        pass

    operator._list = listed  # type: ignore[method-assign]
    leading = asyncio.create_task(operator.lead())
    try:
        async with asyncio.timeout(10):
            while True:
                key, found = await seen.get()
                if found is not None:
                    break
        assert (key, found.is_exceeded) == (Key(WORKLOADS.plural, NAMESPACE, "w"), True)
    finally:
        leading.cancel()
        await asyncio.gather(leading, return_exceptions=True)
        operator.queue.close()
