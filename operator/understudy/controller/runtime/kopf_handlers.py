"""The watches by kopf that report changes to the operator.

There are only ``on.event`` handlers, so kopf never writes a finalizer or an annotation to an object. There is no
peering, because the Lease decides which replica acts. kopf writes no Events and no log line per object: at fleet size,
these cost more than the work itself.
"""

from __future__ import annotations

import asyncio
import inspect
import itertools
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import aiohttp
import kopf
from aiohttp.connector import Connection
from kopf._cogs.clients import scanning

from understudy.kube.client import PAGE, POLICIES, POOLS, WORKLOADS, Access, Object, Resource
from understudy.kube.decoding import bounded, decode

WATCHED = (WORKLOADS, POLICIES, POOLS)
"""Understudy's own kinds. watches.py has the other watched resources."""

See = Callable[[Resource, Object, bool], None]


def registry(see: See, access: Access) -> kopf.OperatorRegistry:
    """Return the handlers. Each of them only passes on the change (resource, object, whether it was deleted)."""
    made = kopf.OperatorRegistry()

    def on(resource: Resource) -> None:
        @kopf.on.event(resource.group, resource.version, resource.plural, registry=made, id="see")
        async def handle(event: Any, **_: Any) -> None:
            see(resource, dict(event["object"]), event["type"] == "DELETED")

    for resource in WATCHED:
        on(resource)

    sessions = itertools.count()

    @kopf.on.login(registry=made)
    async def login(**_: Any) -> Any:
        if next(sessions) and access.plugin is not None:  # kopf asks again after a 401
            access.plugin.reject()
        return _session(access, await access.bearer())

    @kopf.on.cleanup(registry=made)
    async def end_scans(**_: Any) -> None:
        # If kopf stops while it asks which kinds exist, it leaves these requests behind. It then closes their connections,
        # and each of them would end with a traceback.
        left = [task for task in asyncio.all_tasks() if getattr(task.get_coro(), "cr_code", None) in _SCANS]
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)

    return made


_SCANS = {found.__code__ for found in vars(scanning).values() if inspect.iscoroutinefunction(found)}


def _session(access: Access, token: str | None) -> kopf.AiohttpSession:
    """Return a session with the operator's credentials."""
    headers = {"Authorization": f"Bearer {token}", "User-Agent": "understudy-operator"} if token else {}
    connector = aiohttp.TCPConnector(ssl=access.context, limit=0)
    session = aiohttp.ClientSession(connector=connector, headers=headers, response_class=_Answer)
    return kopf.AiohttpSession(server=access.server, aiohttp_session=session)


class _Answer(aiohttp.ClientResponse):
    """An answer of the API server without values that are nested too deeply: they would end kopf's decoding, and so kopf."""

    async def start(self, connection: Connection) -> aiohttp.ClientResponse:
        await super().start(connection)
        self.content = _Lines(self.content)  # type: ignore[assignment]
        return self

    async def json(self, *, loads: Callable[[str], Any] = decode, **options: Any) -> Any:
        return await super().json(loads=loads, **options)


class _Lines:
    """The content of an answer. kopf reads the events of a watch from it, which are lines."""

    def __init__(self, content: aiohttp.StreamReader) -> None:
        self._content = content

    def __getattr__(self, name: str) -> Any:
        return getattr(self._content, name)

    async def iter_chunked(self, size: int) -> AsyncIterator[bytes]:
        rest = b""
        async for chunk in self._content.iter_chunked(size):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                yield bounded(line.decode()).encode() + b"\n"
        yield bounded(rest.decode()).encode()


class _NoDifferences(kopf.DiffBaseStorage):
    """Nobody handles differences. To find them, kopf would copy every object: 0.6 s for one with 250,000 values."""

    def build(self, *, body: kopf.Body, extra_fields: Any = None) -> kopf.BodyEssence:
        return kopf.BodyEssence()

    def fetch(self, *, body: kopf.Body) -> kopf.BodyEssence | None:
        return None

    def store(self, *, body: kopf.Body, patch: kopf.Patch, essence: kopf.BodyEssence) -> None:
        return


def settings() -> kopf.OperatorSettings:
    """Return kopf's settings for watching and nothing else."""
    made = kopf.OperatorSettings()
    made.persistence.diffbase_storage = _NoDifferences()
    made.posting.enabled = False
    made.peering.standalone = True
    made.watching.connect_timeout = 10
    made.watching.server_timeout = 300
    made.watching.inactivity_timeout = 70
    made.watching.chunk_size = PAGE
    made.queueing.idle_timeout = 1
    made.networking.request_timeout = 60
    made.process.ultimate_exiting_timeout = 30
    return made


def quiet() -> None:
    """Suppress kopf's log lines for each object and event."""
    logging.getLogger("kopf.objects").setLevel(logging.WARNING)
    logging.getLogger("kopf").setLevel(logging.WARNING)


async def watch(see: See, access: Access, namespaces: Sequence[str]) -> None:
    """Watch until cancelled, or until a signal stops it."""
    await kopf.operator(
        registry=registry(see, access),
        settings=settings(),
        standalone=True,
        clusterwide=not namespaces,
        namespaces=list(namespaces),
    )
