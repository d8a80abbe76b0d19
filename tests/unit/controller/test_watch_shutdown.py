"""An operator that is stopped while it starts ends without tracebacks."""

from __future__ import annotations

import asyncio
import gc
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from aiohttp import web

from tests.support.http_server import serving
from understudy.controller.runtime import kopf_handlers
from understudy.kube.client import Access


@asynccontextmanager
async def slow_api_server(asked: asyncio.Event) -> AsyncIterator[str]:
    """A server that begins each answer and does not end it. Yields its URL."""
    over = asyncio.Event()

    async def begin(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse()
        await response.prepare(request)
        await response.write(b"{")
        asked.set()
        await over.wait()
        return response

    app = web.Application()
    app.router.add_route("*", "/{path:.*}", begin)
    async with serving(app) as url:
        try:
            yield url
        finally:
            over.set()


async def test_an_operator_that_stops_while_it_asks_for_the_kinds_leaves_no_traceback() -> None:
    kopf_handlers.quiet()
    left: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: left.append(context))
    asked = asyncio.Event()
    async with slow_api_server(asked) as url:
        access = Access(server=url, context=ssl.create_default_context())
        watching = asyncio.create_task(kopf_handlers.watch(lambda *_: None, access, []))
        async with asyncio.timeout(10):
            await asked.wait()
        await asyncio.sleep(0.05)  # so that the beginning of the answer has arrived
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        del watching  # the traceback of its cancellation refers to the requests
        await asyncio.sleep(0)
        gc.collect()  # asyncio reports the exception of a task when the task is collected
    assert left == []
