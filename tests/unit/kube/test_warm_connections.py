"""A monitor's connections stay open while it has nothing to ask, over real HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator

import pytest
from aiohttp import web

from tests.support.http_server import serving
from understudy.kube.client import PODS, Access, ApiError, Client
from understudy.kube.warm_connections import keep_warm

IDLE = 0.6  # seconds; a busy machine delays what keeps connections open


class Server:
    """Closes idle connections, as an API server does, and records the connection of each request for pods."""

    def __init__(self) -> None:
        self.connections: set[object] = set()
        self.asked: list[bool] = []
        """Whether each question for pods came by a connection that had been used before."""
        self.versions = 0
        self.status = 200
        self.address = ""

    async def pods(self, request: web.Request) -> web.Response:
        self.asked.append(request.transport in self.connections)
        self.connections.add(request.transport)
        await asyncio.sleep(0.05)
        return web.json_response({"metadata": {}, "items": []})

    async def version(self, request: web.Request) -> web.Response:
        self.connections.add(request.transport)
        self.versions += 1
        await asyncio.sleep(0.02)
        return web.json_response({"major": "1"}, status=self.status)


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    found = Server()
    app = web.Application()
    app.router.add_get("/api/v1/namespaces/fleet/pods", found.pods)
    app.router.add_get("/version", found.version)
    async with serving(app, keepalive_timeout=IDLE) as found.address:
        yield found


@contextlib.asynccontextmanager
async def warmed(client: Client) -> AsyncIterator[None]:
    task = asyncio.create_task(keep_warm(client, 2, every=IDLE / 6))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_two_simultaneous_requests_after_an_idle_time_need_no_new_connection(server: Server) -> None:
    async with Client(Access(server.address, ssl.create_default_context())) as client:
        async with warmed(client):
            await asyncio.sleep(3 * IDLE)
            await asyncio.gather(client.list(PODS, "fleet"), client.list(PODS, "fleet"))
        assert server.asked == [True, True]

        await asyncio.sleep(3 * IDLE)
        await client.list(PODS, "fleet")
        assert server.asked[-1] is False, "without it the server has closed them"


async def test_a_refused_request_keeps_the_connection_open_too(server: Server) -> None:
    server.status = 403
    async with Client(Access(server.address, ssl.create_default_context())) as client, warmed(client):
        await asyncio.sleep(3 * IDLE)
        with pytest.raises(ApiError):
            await client.read("/version")
        await client.list(PODS, "fleet")
    assert server.asked == [True]


async def test_warming_continues_while_the_api_server_is_unavailable() -> None:
    async with Client(Access("http://127.0.0.2:1", ssl.create_default_context())) as client:
        task = asyncio.create_task(keep_warm(client, 2, every=0.01))
        await asyncio.sleep(0.1)
        assert not task.done()
        task.cancel()
