"""What the health tree judges of the pod in control by what the cluster says of it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.observed_robot import observing, policy_with
from understudy.api import names
from understudy.failover.interfaces import Instance
from understudy.kube.client import POD_METRICS, ApiError, Object
from understudy.monitor.observe.objects import resource_meter
from understudy.monitor.observe.objects.resource_meter import ResourceMeter
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.observations import PodCondition

pytestmark = pytest.mark.ros


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch) -> Iterator[HealthObserver]:
    yield from observing(monkeypatch)


def _instance(name: str, ready: str, restarts: int = 0) -> Instance:
    return Instance(name, f"uid-{name}", restarts=restarts, conditions=(PodCondition("Ready", ready),))


def test_a_pod_leaf_is_judged_by_the_status_of_the_active_pod(
    observer: HealthObserver,
) -> None:
    observer.follow(policy_with({"pod": {"condition": "Ready"}}), None)
    assert observer.summary == "Watching pod."
    active, standby = _instance("w-1", "True"), _instance("w-2", "False")
    since = time.time()
    observer.drain([active, standby], "w-1")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([active, _instance("w-2", "Unknown")], "w-1")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([_instance("w-1", "False"), standby], "w-1")
    verdict = observer.verdict(now=time.time(), since=since)
    assert (verdict.state, verdict.leaf) == ("Failed", "pod.Ready")
    since = time.time()
    assert observer.verdict(now=time.time(), since=since).state == "Starting", "nobody has looked at the next one"
    observer.drain([_instance("w-2", "True")], "w-2")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([], "w-2")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy", "what is gone is told otherwise"


def test_restarts_of_the_active_instance_count(observer: HealthObserver) -> None:
    observer.follow(policy_with({"pod": {"restarts": 1, "window": "10m"}}), None)
    since = time.time()
    for restarts, expected in ((4, "Healthy"), (5, "Healthy"), (6, "Failed")):
        observer.drain([_instance("w-1", "True", restarts), _instance("w-2", "True", 9 * restarts)], "w-1")
        assert observer.verdict(now=time.time(), since=since).state == expected


def test_the_state_of_the_pod_is_updated_and_only_if_the_tree_needs_it(observer: HealthObserver) -> None:
    instances = [_instance("w-1", "True")]
    observer.drain(instances, "w-1")
    assert observer.observations.pod() is None
    observer.follow(policy_with({"pod": {"condition": "Ready"}}), None)
    observer.drain(instances, "w-1")
    first = observer.observations.pod()
    assert first is not None
    end = time.monotonic() + 20
    while observer.observations.pod() is first and time.monotonic() < end:
        observer.drain(instances, "w-1")
        time.sleep(0.02)
    assert observer.observations.pod().received > first.received


METRICS = "CPU and memory of pods are unknown"


class Metered:
    """An observer whose meter asks an API server, and what that says a pod uses."""

    def __init__(self, observer: HealthObserver, client: MemoryClient) -> None:
        self.observer, self.client = observer, client
        self.since = time.time()

    @property
    def asked(self) -> int:
        """How often the API server was asked."""
        return sum(name == POD_METRICS.plural for _, name, _ in self.client.requests)

    def uses(self, pod: str, memory: str) -> None:
        """Have a pod use so much memory."""
        metadata = {"name": pod, "labels": {names.WORKLOAD: "w"}}
        containers = [{"name": "drive", "usage": {"cpu": "1", "memory": memory}}]
        item: Object = {"metadata": metadata, "timestamp": memory, "containers": containers}
        self.client.store(POD_METRICS, "fleet", item)

    async def until(self, holds: Callable[[], object], active: str = "w-1") -> None:
        """Look until something holds."""
        async with asyncio.timeout(20):
            while not holds():
                self.observer.drain([_instance("w-1", "True"), _instance("w-2", "True")], active)
                await asyncio.sleep(0.02)

    def judged(self) -> Verdict:
        """The verdict now."""
        return self.observer.verdict(now=time.time(), since=self.since)


async def test_the_usage_of_the_pod_is_requested_only_if_the_tree_needs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resource_meter, "PERIOD", 0.02)
    client = MemoryClient()
    meter = ResourceMeter(client, "fleet", "w")
    with contextlib.contextmanager(observing)(monkeypatch, meter) as observer:
        world, asking = Metered(observer, client), asyncio.create_task(meter.run())
        observer.follow(policy_with({"pod": {"condition": "Ready"}}), None)
        await world.until(lambda: world.judged().state == "Healthy")
        assert not world.asked, "no leaf needs it"
        observer.follow(policy_with({"pod": {"memory": "< 200Mi"}}), None)
        await world.until(lambda: world.judged().state == "Healthy" and world.asked)  # there are no figures yet
        world.uses("w-1", "300Mi")
        await world.until(lambda: world.judged().state == "Failed")
        assert_golden("monitor", world.judged().reason, "memory < 200Mi", "300Mi")
        await world.until(lambda: meter.usage is None, active="w-2")
        client.failing = lambda method, name: ApiError(500, "Error", "because") if name == POD_METRICS.plural else None
        await world.until(lambda: any(f"{METRICS}: because" in one for one in observer.problems), active="w-2")
        asking.cancel()
