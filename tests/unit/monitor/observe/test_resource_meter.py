"""What the pod in control takes, by a metrics API that speaks over real HTTP."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from aiohttp import web

from tests.support.golden import assert_golden
from understudy.api import names
from understudy.kube.client import Access, Client
from understudy.monitor.observe.objects import resource_meter
from understudy.monitor.observe.objects.resource_meter import ResourceMeter


class MetricsApi:
    """metrics.k8s.io as metrics-server serves it."""

    def __init__(self) -> None:
        self.items: list[dict[str, Any]] = []
        self.refusal: tuple[int, str] | None = None
        self.requests: list[str] = []

    async def answer(self, request: web.Request) -> web.Response:
        self.requests.append(request.query["labelSelector"])
        if self.refusal is not None:
            status, message = self.refusal
            body = {"kind": "Status", "status": "Failure", "code": status, "reason": "R", "message": message}
            return web.json_response(body, status=status)
        return web.json_response(
            {"kind": "PodMetricsList", "apiVersion": "metrics.k8s.io/v1beta1", "items": self.items}
        )

    def has(self, pod: str, stamp: int, **containers: tuple[str, str]) -> None:
        """Figures of a pod: cpu and memory by container."""
        found = [
            {"name": name.replace("_", "-"), "usage": {"cpu": cpu, "memory": memory}}
            for name, (cpu, memory) in containers.items()
        ]
        item = {
            "metadata": {"name": pod, "namespace": "fleet", "labels": {names.WORKLOAD: "w"}},
            "timestamp": f"2026-01-01T00:00:{stamp:02}Z",
            "window": "15.1s",
            "containers": found,
        }
        self.items = [other for other in self.items if other["metadata"]["name"] != pod] + [item]


@pytest.fixture
async def api() -> AsyncIterator[tuple[MetricsApi, str]]:
    served, app = MetricsApi(), web.Application()
    app.router.add_get("/apis/metrics.k8s.io/v1beta1/namespaces/fleet/pods", served.answer)
    runner = web.AppRunner(app)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    yield served, f"http://127.0.0.1:{runner.addresses[0][1]}"
    await runner.cleanup()


@pytest.fixture
async def meter(api: tuple[MetricsApi, str], monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[ResourceMeter]:
    monkeypatch.setattr(resource_meter, "PERIOD", 0.02)
    async with Client(Access(server=api[1], context=ssl.create_default_context())) as client:
        made = ResourceMeter(client, "fleet", "w")
        task = asyncio.create_task(made.run())
        yield made
        task.cancel()


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(20):
        while not holds():
            await asyncio.sleep(0.01)


async def test_the_usage_is_the_sum_of_the_containers_without_the_agent(api: Any, meter: ResourceMeter) -> None:
    served, _ = api
    served.has("w-1", 1, drive=("250m", "100Mi"), arm=("50000000n", "20480Ki"), understudy_agent=("9", "9Gi"))
    served.has("w-2", 1, drive=("7", "7Gi"))
    assert names.AGENT_CONTAINER == "understudy-agent"
    meter.want("w-1")
    await until(lambda: meter.usage)
    assert meter.usage is not None
    assert meter.usage.cpu == pytest.approx(0.3)
    assert meter.usage.memory == pytest.approx(120 * 2**20)
    assert served.requests[0] == f"{names.WORKLOAD}=w"
    served.has("w-1", 2, drive=("1", "1Mi"))
    await until(lambda: meter.usage is not None and meter.usage.cpu == 1.0)
    meter.want("w-2")
    assert meter.usage is None, "of another pod they say nothing"
    await until(lambda: meter.usage is not None and meter.usage.cpu == 7.0)
    assert meter.problems == []


async def test_nothing_is_requested_while_no_leaf_needs_it(api: Any, meter: ResourceMeter) -> None:
    served, _ = api
    await asyncio.sleep(0.1)
    assert served.requests == []
    meter.want("w-1")
    await until(lambda: served.requests)
    meter.want("")
    await asyncio.sleep(0.1)
    count = len(served.requests)
    await asyncio.sleep(0.2)
    assert len(served.requests) == count


@pytest.mark.parametrize(
    ("refusal", "expected"),
    [
        ((404, "the server could not find the requested resource"), "the cluster has no metrics API"),
        ((403, "pods.metrics.k8s.io is forbidden"), "are unknown: pods.metrics.k8s.io is forbidden."),
        ((503, "the server is currently unable to handle the request"), "is currently unable to handle"),
    ],
)
async def test_the_reason_for_missing_usage_is_reported(
    api: Any, meter: ResourceMeter, refusal: tuple[int, str], expected: str
) -> None:
    served, _ = api
    served.refusal = refusal
    meter.want("w-1")
    await until(lambda: meter.problems)
    (problem,) = meter.problems
    assert expected in problem
    served.refusal = None
    served.has("w-1", 1, drive=("1", "1Mi"))
    await until(lambda: meter.usage)
    assert meter.problems == []
    served.refusal = refusal
    count = len(served.requests)
    await until(lambda: len(served.requests) > count + 2)
    assert meter.usage is not None, "the last ones are of just now"
    assert meter.problems == []


async def test_usage_that_is_not_updated_becomes_unknown(
    api: Any, meter: ResourceMeter, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, _ = api
    served.has("w-1", 1, drive=("1", "1Mi"))
    meter.want("w-1")
    await until(lambda: meter.usage)
    monkeypatch.setattr(resource_meter, "STALE", 0.2)
    await until(lambda: meter.usage is None)
    (problem,) = meter.problems
    assert_golden("monitor", problem, "w-1", "0.2 s")
    monkeypatch.setattr(resource_meter, "STALE", 90.0)
    served.has("w-1", 2, drive=("2", "1Mi"))
    await until(lambda: meter.usage is not None and meter.usage.cpu == 2.0)


@pytest.mark.parametrize("items", [None, [7], [{"metadata": {"name": "w-1"}}]])
async def test_an_unexpected_answer_is_reported_and_the_requests_continue(
    api: Any, meter: ResourceMeter, items: Any
) -> None:
    served, _ = api
    served.items = items
    meter.want("w-1")
    await until(lambda: meter.problems)
    assert "returned an unexpected answer" in meter.problems[0]
    served.items = []
    served.has("w-1", 1, drive=("1", "1Mi"))
    await until(lambda: meter.usage)
