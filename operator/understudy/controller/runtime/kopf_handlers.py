"""The watches by kopf that report changes to the operator.

There are only ``on.event`` handlers, so kopf never writes a finalizer or an annotation to an object. There is no
peering, because the Lease decides which replica acts. kopf writes no Events and no log line per object: at fleet size,
these cost more than the work itself.
"""

from __future__ import annotations

import asyncio
import inspect
import itertools
import json
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import aiohttp
import kopf
from aiohttp.connector import Connection
from kopf._cogs.clients import scanning
from kopf._cogs.structs import references
from kopf._core.reactor import observation

from understudy.kube.client import PAGE, POLICIES, POOLS, WORKLOADS, Access, Object, Resource
from understudy.kube.decoding import LONG, bounded, decoded

WATCHED = (WORKLOADS, POLICIES, POOLS)
"""Understudy's own kinds. watches.py has the other watched resources."""

See = Callable[[Resource, Object, bool], None]


def registry(see: See, access: Access) -> kopf.OperatorRegistry:
    """Return the handlers. Each of them only passes on the change (resource, object, whether it was deleted)."""
    made, long_objects = kopf.OperatorRegistry(), LongObjects()

    def on(resource: Resource) -> None:
        @kopf.on.event(resource.group, resource.version, resource.plural, registry=made, id="see")
        async def handle(event: Any, **_: Any) -> None:
            gone = event["type"] == "DELETED"
            found = long_objects.whole(event["object"])
            if found is not None or gone:
                see(resource, dict(event["object"]) if found is None else found, gone)

    for resource in WATCHED:
        on(resource)

    sessions = itertools.count()

    @kopf.on.login(registry=made)
    async def login(**_: Any) -> Any:
        if next(sessions) and access.plugin is not None:  # kopf asks again after a 401
            access.plugin.reject()
        return _session(access, await access.bearer(), long_objects)

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


def _session(access: Access, token: str | None, long_objects: LongObjects) -> kopf.AiohttpSession:
    """Return a session with the operator's credentials."""
    headers = {"Authorization": f"Bearer {token}", "User-Agent": "understudy-operator"} if token else {}
    connector = aiohttp.TCPConnector(ssl=access.context, limit=0)
    session = aiohttp.ClientSession(connector=connector, headers=headers, response_class=_answers(long_objects))
    return kopf.AiohttpSession(server=access.server, aiohttp_session=session)


def _answers(long_objects: LongObjects) -> type[aiohttp.ClientResponse]:
    class Answer(aiohttp.ClientResponse):
        """An answer of the API server without values that are nested too deeply: they would end kopf's decoding, and so kopf."""

        async def start(self, connection: Connection) -> aiohttp.ClientResponse:
            await super().start(connection)
            self.content = _Lines(self.content, long_objects)  # type: ignore[assignment]
            return self

        async def json(self, *, loads: Callable[[str], Any] = str, **options: Any) -> Any:
            text = await super().json(loads=loads, **options)
            return None if text is None else await decoded(text)

    return Answer


class LongObjects:
    """Keeps the whole content of objects with long texts, of which kopf receives the metadata only.

    The depth of a long text is only known once it is decoded. kopf would decode it again, with collections of garbage meanwhile.
    """

    def __init__(self) -> None:
        self._latest: dict[str, Object] = {}
        """By UID, the objects that the handler has not received yet."""

    async def shortened(self, line: str) -> str:
        """Return a line of a watch as kopf decodes it. Raises ValueError."""
        if len(line) < LONG:
            return bounded(line)
        event = await decoded(line)
        item = event["object"]
        metadata = item.get("metadata") or {}
        if "uid" not in metadata:  # an error
            return bounded(line)
        self._latest[metadata["uid"]] = item
        kept = {key: metadata[key] for key in _IDENTITY if key in metadata}
        return json.dumps({**event, "object": {**_kind(item), _SHORTENED: True, "metadata": kept}})

    def whole(self, item: kopf.RawBody) -> Object | None:
        """Return the object that kopf has received; None if this or a newer version of it was returned before."""
        latest = self._latest.pop(item["metadata"].get("uid", ""), None)
        return latest if _SHORTENED in item else dict(item)


_SHORTENED = "shortened"
"""Marks an object without its content. Objects of the API server have no such field at their top."""

_IDENTITY = ("name", "namespace", "uid", "resourceVersion")


def _kind(item: Object) -> Object:
    return {key: item[key] for key in ("apiVersion", "kind") if key in item}


class _Lines:
    """The content of an answer. kopf reads the events of a watch from it, which are lines."""

    def __init__(self, content: aiohttp.StreamReader, long_objects: LongObjects) -> None:
        self._content, self._long_objects = content, long_objects

    def __getattr__(self, name: str) -> Any:
        return getattr(self._content, name)

    async def iter_chunked(self, size: int) -> AsyncIterator[bytes]:
        rest = b""
        async for chunk in self._content.iter_chunked(size):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                yield (await self._long_objects.shortened(line.decode())).encode() + b"\n"
        yield (await self._long_objects.shortened(rest.decode())).encode()


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
    if namespaces:
        # The chart gives no right to list namespaces then. kopf tries nine times, and logs each, before it assumes that they
        # exist. So its insights name them from the beginning.
        logging.getLogger(observation.__name__).setLevel(logging.CRITICAL)
    await kopf.operator(
        registry=registry(see, access),
        settings=settings(),
        standalone=True,
        clusterwide=not namespaces,
        namespaces=list(namespaces),
        insights=references.Insights(namespaces={references.NamespaceName(name) for name in namespaces}),
    )
