"""Several monitors' own parts at one pool and one API server in memory, whose watches are late: claims, gates and who waits."""

from __future__ import annotations

import asyncio
import copy
import itertools
import random
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.answers import tabled
from tests.unit.interleavings.apiserver import Event, selecting, watch_event
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover import pool_queue
from understudy.failover.interfaces import Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice, StrategyContext
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.kube import claims
from understudy.kube.client import NETWORK_POLICIES, PODS, Object, Resource
from understudy.kube.watched_collection import Reflector
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.act.recovery.pool_waiting import REASON, PoolQueue
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

POOL = "spare"
LAG = 0.03
"""Maximum seconds after which a watch reports a write."""


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody here has died, so nobody is passed over, however busy the machine is."""
    monkeypatch.setattr(pool_queue, "YIELD", 30.0)
    monkeypatch.setattr(pool_queue, "YIELD_MOST", 30.0)


class Cluster(MemoryClient):
    """An API server in memory that tells monitors of its writes, each by its own watches and in its own time."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.monitors: list[Monitor] = []
        self.names = itertools.count(1)
        self._random = random.Random(seed)
        self._pods: list[Event] = []
        self._written = asyncio.Event()
        self.asked: list[str] = []
        """The labels that selected pods in lists and watches."""

    async def create(self, resource: Resource, namespace: str | None, body: Object, *, dry_run: bool = False) -> Object:
        made = await super().create(resource, namespace, body)
        self._tell(resource, None, made)
        return made

    async def patch(self, resource: Resource, namespace: str | None, name: str, body: Any, **more: Any) -> Object:
        await asyncio.sleep(self._random.uniform(0, LAG / 3))
        old = copy.deepcopy(self.items.get((resource.plural, namespace or "", name)))
        made = await super().patch(resource, namespace, name, body, **more)
        self._tell(resource, old, made)
        await asyncio.sleep(self._random.uniform(0, LAG / 3))
        return made

    async def list(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        labels: str | None = None,
        fields: str | None = None,
        cached: bool = False,
    ) -> Object:
        """Only pods: monitors learn of other objects without asking."""
        self.asked.append(labels or "")
        await asyncio.sleep(self._random.uniform(0, LAG / 3))
        chosen = selecting(labels, fields)
        pods = [item for (plural, _, _), item in self.items.items() if plural == resource.plural and chosen(item)]
        version = self._pods[-1].version if self._pods else 0
        return {"metadata": {"resourceVersion": str(version)}, "items": copy.deepcopy(pods)}

    async def table(self, *args: Any, **selectors: Any) -> Object:
        return tabled(await self.list(*args, **selectors))

    async def watch(
        self, resource: Resource, namespace: str | None = None, *, version: str, **selectors: Any
    ) -> AsyncIterator[tuple[str, Object]]:
        """Of pods."""
        self.asked.append(f"watch {selectors['labels']}")
        chosen = selecting(selectors["labels"], selectors["fields"])
        at = sum(event.version <= int(version) for event in self._pods)
        while True:
            while at == len(self._pods):
                await self._written.wait()
            await asyncio.sleep(self._random.uniform(0, LAG))
            if (found := watch_event(self._pods[at], chosen)) is not None:
                yield found
            at += 1

    def _tell(self, resource: Resource, old: Object | None, item: Object) -> None:
        if resource is PODS:
            self._pods.append(Event(int(item["metadata"]["resourceVersion"]), old, item))
            self._written.set()
            self._written = asyncio.Event()
        loop = asyncio.get_running_loop()
        for monitor in self.monitors:
            monitor.delivered_at = max(monitor.delivered_at, loop.time() + self._random.uniform(0, LAG))  # in order
            loop.call_at(monitor.delivered_at, monitor.hear, resource, item)

    async def add_pod(self) -> str:
        """A pod of the pool that becomes ready."""
        name = f"spare-{next(self.names)}"
        labels = {
            names.POOL: POOL,
            names.HELD: "true",
            names.WORKLOAD: names.UNCLAIMED,
            names.CLAIMED_BY: names.UNCLAIMED,
            names.INSTANCE: name,
            names.TEMPLATE_HASH: "h",
            names.PART: claims.part(name),
        }
        status = {"phase": "Running", "podIP": "10.0.0.1", "conditions": [{"type": "Ready", "status": "True"}]}
        body = {
            "metadata": {"name": name, "labels": labels, "annotations": {}, "creationTimestamp": name},
            "spec": {"containers": [{"name": names.AGENT_CONTAINER}]},
            "status": status,
        }
        await self.create(PODS, "fleet", body)
        return name

    def owners(self) -> dict[str, str]:
        """The workload of each pod that has one."""
        pods = [item for (plural, _, _), item in self.items.items() if plural == PODS.plural]
        found = {pod["metadata"]["name"]: claims.workload_of(pod["metadata"]["labels"]) for pod in pods}
        return {pod: workload for pod, workload in found.items() if workload}

    def writes(self, *ending: str) -> int:
        """Writes to objects whose names end so, refused ones included."""
        return sum(method == "PATCH" and name.endswith(ending) for method, name, _ in self.requests)


class Monitor:
    """What of a monitor has to do with pods, gates and others; its instances start at once and drive as soon as they may."""

    def __init__(self, cluster: Cluster, workload: str, priority: int, state: Path) -> None:
        self.cluster, self.workload = cluster, workload
        self.delivered_at = 0.0
        self.view = ClusterView(cluster, "fleet", workload, Wakeups())
        self.settings = WorkloadSettings(
            workload=workload,
            namespace="fleet",
            uid=f"uid-{workload}",
            source_kind="ReplicaSet",
            source_name=workload,
            pools=[PoolChoice(name=POOL, readiness="Uninitialized", template_hash="h")],
        )
        data = {"settings.json": self.settings.model_dump_json(by_alias=True)}
        self.view.settings_maps.put(
            {"metadata": {"name": names.settings(workload), "resourceVersion": "1"}, "data": data}
        )
        spec = {
            "template": {},
            "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
            "failurePolicyRef": {"name": "p"},
            "poolPriority": priority,
        }
        self.view.workloads.put({"metadata": {"name": workload, "resourceVersion": "1"}, "spec": spec})
        self.notices = Notices()
        steps = CrashPoints(state)
        self.fleet = PodControl(cluster, self.view, steps, self.notices)
        self.gate = GateControl(cluster, self.view, self.fleet, self, steps, self.notices)  # type: ignore[arg-type]
        cluster.monitors.append(self)

    def deciding(self) -> None:
        """There is no mux."""

    def committed(self, epoch: int) -> None:
        """There is no mux."""

    def hear(self, resource: Resource, item: Object) -> None:
        """What its watches tell it of a write."""
        labels, name = item["metadata"].get("labels") or {}, item["metadata"]["name"]
        if resource is PODS:
            _watched(self.view.pods, item, selected=labels.get(names.WORKLOAD) == self.workload)
            _watched(self.view.claimed_pods, item, selected=labels.get(names.CLAIMED_BY) == self.workload)
        if resource is NETWORK_POLICIES:
            _watched(self.view.waiting_gates[0], item, selected=names.WAITS_FOR in labels)
            if name == names.gate(self.workload):
                self.view.gates.put(item)

    async def begin(self) -> None:
        """Its gate, which lets an instance through that has failed."""
        annotations = {names.EPOCH: "1", names.ACTIVE: f"{self.workload}-1", names.ACTIVE_UID: f"uid-{self.workload}-1"}
        metadata = {"name": names.gate(self.workload), "labels": {"app": "x"}, "annotations": annotations}
        made = await self.cluster.create(NETWORK_POLICIES, "fleet", {"metadata": metadata, "spec": {"podSelector": {}}})
        self.view.gates.put(made)

    async def fails(self, *, wait_for: float) -> Progress:
        """A recovery, from its detection to its end."""
        now = time.time()
        failed = [PodIdentity(name=f"{self.workload}-1", uid=f"uid-{self.workload}-1")]
        progress = Progress.begin("it ended", last_healthy=now, detected=now, failed=failed)
        self.notices.condition("Recovering", "True", "FailureDetected", progress.reason)
        ladder = [Choice(UninitializedFallback(POOL, wait_for=wait_for), 2.0)]
        return await recover(progress, ladder, self.context())

    def context(self) -> StrategyContext:
        return StrategyContext(
            gate=self.gate,
            instances=self.fleet,
            agents=self,  # type: ignore[arg-type]
            outputs=self,  # type: ignore[arg-type]
            queue=PoolQueue(self.view, self.notices),
            clock=time.time,
            save=lambda progress: None,
            workload_uid=self.settings.uid,
        )

    @property
    def waits(self) -> bool:
        return self.notices.status.reason("Recovering") == REASON

    # What is beyond pods and policies: agents, packets and outputs, all of them as quick as can be.

    async def start(self, instance: Instance) -> None:
        return

    def follow(self, instances: Sequence[Instance]) -> None:
        return

    async def probe(self, instance: Instance, duration: float) -> None:
        return

    async def up(self, instance: Instance) -> float:
        await asyncio.sleep(0.05)
        return time.time()

    async def ready(self, instance: Instance) -> float:
        return time.time()

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        return True, ""

    async def wait(self, uid: str, since: float) -> float:
        return time.time()

    blind = False

    async def heard_held_back(self, instance: Instance) -> None:
        return

    async def first_from(self, instance: Instance, *, since: float) -> float:
        return time.time()

    def last(self, uid: str) -> float | None:
        return None

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        return 0.0, ""

    def switched_to(self, instance: Instance) -> str:
        return ""

    def period_of_others(self, instance: Instance) -> float:
        return 0.0


def _watched(known: Reflector, item: Object, *, selected: bool) -> None:
    """What a watch by labels does: an object that no longer has them is gone from it."""
    if selected:
        known.put(item)
    elif item["metadata"]["name"] in known.items:
        known.apply_event("DELETED", item)


async def fleet(cluster: Cluster, priorities: Sequence[int], state: Path) -> list[Monitor]:
    found = [Monitor(cluster, f"robot-{i}", priority, state) for i, priority in enumerate(priorities)]
    for monitor in found:
        await monitor.begin()
    return found


async def all_wait(monitors: Sequence[Monitor]) -> None:
    async with asyncio.timeout(20):
        while not all(monitor.waits for monitor in monitors):
            await asyncio.sleep(0.01)
    await asyncio.sleep(3 * LAG)


@pytest.mark.parametrize("seed", range(4))
async def test_single_pods_are_served_by_priority_and_then_by_waiting_time(seed: int, tmp_path: Path) -> None:
    cluster = Cluster(seed)
    monitors = await fleet(cluster, [0, 5, 0, 100], tmp_path)
    tasks = []
    for monitor in monitors:
        tasks.append(asyncio.create_task(monitor.fails(wait_for=60)))
        await all_wait([monitor])
    served = []
    for _ in monitors:
        pod = await cluster.add_pod()
        async with asyncio.timeout(20):
            while pod not in cluster.owners():
                await asyncio.sleep(0.005)
        served.append(cluster.owners()[pod])
    assert served == ["robot-3", "robot-1", "robot-0", "robot-2"]
    done = await asyncio.gather(*tasks)
    assert {progress.result for progress in done} == {"Recovered"}
    assert [monitor.gate.state.active for monitor in monitors] == [p.target.name for p in done if p.target]
    assert cluster.writes("-gate") == 3 * len(monitors), (
        "closed, no longer waiting, open: one more than without waiting"
    )


@pytest.mark.parametrize("seed", range(4))
async def test_simultaneous_pods_are_claimed_at_once_by_different_workloads(seed: int, tmp_path: Path) -> None:
    cluster = Cluster(seed)
    monitors = await fleet(cluster, [0, 0, 7, 7], tmp_path)
    tasks = [asyncio.create_task(monitor.fails(wait_for=60)) for monitor in monitors]
    await all_wait(monitors)
    for _ in monitors:
        await cluster.add_pod()
    done = await asyncio.gather(*tasks)
    assert {progress.result for progress in done} == {"Recovered"}
    assert sorted(cluster.owners().values()) == [monitor.workload for monitor in monitors]


@pytest.mark.parametrize("wait_for", [0.0, 0.3])
async def test_if_pods_are_scarce_each_serves_one_workload_and_the_others_continue(
    wait_for: float, tmp_path: Path
) -> None:
    cluster = Cluster(1)
    monitors = await fleet(cluster, [0, 1, 2, 3, 4], tmp_path)
    for _ in range(2):
        await cluster.add_pod()
    await asyncio.sleep(2 * LAG)
    done = await asyncio.gather(*(monitor.fails(wait_for=wait_for) for monitor in monitors))
    assert [progress.result for progress in done].count("Recovered") == 2
    assert len(set(cluster.owners().values())) == 2
    lost = [progress.attempts[0] for progress in done if progress.result != "Recovered"]
    assert {attempt.result for attempt in lost} == {"NotAvailable"}
    assert all(("no pod became free within 0.3 s" in attempt.message) == bool(wait_for) for attempt in lost)


async def test_without_a_queue_a_claim_needs_no_additional_writes(tmp_path: Path) -> None:
    cluster = Cluster(1)
    (monitor,) = await fleet(cluster, [0], tmp_path)
    await cluster.add_pod()
    await asyncio.sleep(2 * LAG)
    done = await monitor.fails(wait_for=60)
    assert done.result == "Recovered"
    assert "queued" not in done.moments
    assert cluster.writes("-gate") == 2
    assert cluster.writes("-1") == 1


async def test_a_full_pool_is_not_watched_and_mostly_listed_in_part(tmp_path: Path) -> None:
    cluster = Cluster(2)
    monitors = await fleet(cluster, [0] * 12, tmp_path)
    for _ in range(100):
        await cluster.add_pod()
    done = await asyncio.gather(*(monitor.fails(wait_for=5.0) for monitor in monitors))
    assert {progress.result for progress in done} == {"Recovered"}
    assert len(cluster.owners()) == len(monitors)
    assert not [asked for asked in cluster.asked if asked.startswith("watch")]
    assert sum(names.PART in asked for asked in cluster.asked) >= len(monitors)
    assert all(f"{names.POOL}={POOL}" in asked for asked in cluster.asked)


async def test_a_waiting_workload_watches_the_pool_only_while_it_waits(tmp_path: Path) -> None:
    cluster = Cluster(3)
    (monitor,) = await fleet(cluster, [0], tmp_path)
    running = asyncio.create_task(monitor.fails(wait_for=60))
    await all_wait([monitor])
    await cluster.add_pod()
    assert (await running).result == "Recovered"
    known = dict(monitor.view.unclaimed(POOL).items)
    await cluster.add_pod()
    await asyncio.sleep(3 * LAG)
    assert monitor.view.unclaimed(POOL).items == known
    assert sum(asked.startswith("watch") for asked in cluster.asked) == 1
