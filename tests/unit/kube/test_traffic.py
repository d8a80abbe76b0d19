"""What goes to and from an API server is counted, over real HTTP."""

from __future__ import annotations

import json
import ssl
import time
from collections.abc import AsyncIterator

import aiohttp
import pytest
from aiohttp import web
from prometheus_client import CollectorRegistry

from understudy.kube.api_traffic import Traffic, plural, series
from understudy.kube.client import PODS, Access, ApiError, Client, Expired


@pytest.fixture
async def server() -> AsyncIterator[str]:
    """Has one pod, of which a watch tells once, and nothing before version 2."""

    async def pods(request: web.Request) -> web.Response:
        if request.query.get("resourceVersion") == "1":
            return web.json_response({"reason": "Expired"}, status=410)
        item = {"metadata": {"name": "a", "resourceVersion": "3"}}
        event = {"type": "ADDED", "object": item} if "watch" in request.query else {"metadata": {}, "items": [item]}
        return web.Response(text=json.dumps(event) + "\n")

    app = web.Application()
    app.router.add_get("/api/v1/namespaces/fleet/pods", pods)
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    yield f"http://127.0.0.1:{runner.addresses[0][1]}"
    await runner.cleanup()


async def test_requests_are_counted_by_result_and_the_times_of_watch_events_are_recorded(server: str) -> None:
    registry = CollectorRegistry()

    def requests(method: str, code: str) -> float | None:
        labels = {"method": method, "resource": "pods", "code": code}
        return registry.get_sample_value("understudy_api_requests_total", labels)

    access = Access(server, ssl.create_default_context())
    async with Client(access, listener=Traffic(*series(registry))) as client:
        await client.list(PODS, "fleet")
        with pytest.raises(ApiError):
            await client.get(PODS, "fleet", "a")
        with pytest.raises(Expired):
            _ = [event async for event in client.watch(PODS, "fleet", version="1")]
        assert registry.get_sample_value("understudy_watch_last_event_timestamp_seconds", {"resource": "pods"}) is None
        before = time.time()
        assert len([event async for event in client.watch(PODS, "fleet", version="2")]) == 1
    assert [requests("GET", "200"), requests("GET", "404")] == [1, 1]
    assert [requests("WATCH", "410"), requests("WATCH", "200")] == [1, 1]
    last_event = registry.get_sample_value("understudy_watch_last_event_timestamp_seconds", {"resource": "pods"})
    assert last_event is not None
    assert before <= last_event <= time.time()

    access, registry = Access("http://127.0.0.2:1", ssl.create_default_context()), CollectorRegistry()
    async with Client(access, listener=Traffic(*series(registry))) as client:
        with pytest.raises(aiohttp.ClientError):
            await client.list(PODS, "fleet")
        assert requests("GET", "error") == 1


@pytest.mark.parametrize(
    ("path", "resource"),
    [
        ("/api/v1/namespaces/fleet/pods/a/eviction", "pods"),
        ("/api/v1/pods", "pods"),
        ("/api/v1/namespaces/fleet", "namespaces"),
        ("/api/v1/nodes/n1", "nodes"),
        ("/apis/understudy.dev/v1alpha1/namespaces/fleet/robotworkloads/a/status", "robotworkloads"),
        ("/apis/understudy.dev/v1alpha1/fallbackpools", "fallbackpools"),
        ("/version", ""),
    ],
)
def test_a_request_is_counted_for_the_resource_of_its_path(path: str, resource: str) -> None:
    assert plural(path) == resource


async def test_a_request_after_the_client_was_closed_fails_as_one_without_an_answer(server: str) -> None:
    async with Client(Access(server, ssl.create_default_context())) as client:
        pass
    with pytest.raises(aiohttp.ClientError, match="closed"):
        await client.get(PODS, "fleet", "a")
