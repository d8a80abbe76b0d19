"""The watches of a fleet that began together end one after the other."""

from __future__ import annotations

import ssl

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from understudy.kube.client import LIFETIME, PODS, Access, Client


async def asked_for(watches: int, lifetime: int | None = None) -> list[int]:
    """The timeouts in seconds that so many watches ask a server for."""
    found: list[int] = []

    async def watched(request: web.Request) -> web.Response:
        found.append(int(request.query["timeoutSeconds"]))
        return web.Response(text="")

    application = web.Application()
    application.router.add_get("/api/v1/namespaces/fleet/pods", watched)
    async with (
        TestServer(application) as server,
        Client(Access(str(server.make_url("/")).rstrip("/"), ssl.create_default_context())) as client,
    ):
        for _ in range(watches):
            async for _event in client.watch(PODS, "fleet", version="1", lifetime=lifetime):
                pytest.fail("it tells nothing")
    return found


async def test_the_watches_end_at_different_times() -> None:
    """Else a thousand monitors that were started by one upgrade would ask for all of theirs at once, every five minutes."""
    found = await asked_for(40)
    assert len(set(found)) > 10
    assert LIFETIME[0] <= min(found)
    assert max(found) <= LIFETIME[1]


async def test_a_given_lifetime_is_used() -> None:
    assert await asked_for(2, 7) == [7, 7]
