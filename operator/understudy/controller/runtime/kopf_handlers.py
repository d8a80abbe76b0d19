"""kopf's part: watches that tell the operator what has changed.

Only ``on.event`` handlers, so kopf never puts a finalizer or an annotation on anybody's object; no peering, since the
Lease decides who acts; no Events of its own, and no log line per object, which costs more than the work at fleet size.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Any

import aiohttp
import kopf

from understudy.kube.client import PAGE, POLICIES, POOLS, WORKLOADS, Access, Object, Resource

WATCHED = (WORKLOADS, POLICIES, POOLS)
"""Our own kinds; what else is watched is in watches.py."""

See = Callable[[Resource, Object, bool], None]


def registry(see: See, access: Access) -> kopf.OperatorRegistry:
    """The handlers; each only hands on what changed (resource, object, whether it's gone)."""
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

    return made


def _session(access: Access, token: str | None) -> kopf.AiohttpSession:
    """A session as whoever the operator is."""
    headers = {"Authorization": f"Bearer {token}", "User-Agent": "understudy-operator"} if token else {}
    connector = aiohttp.TCPConnector(ssl=access.context, limit=0)
    return kopf.AiohttpSession(
        server=access.server, aiohttp_session=aiohttp.ClientSession(connector=connector, headers=headers)
    )


def settings() -> kopf.OperatorSettings:
    """kopf's settings for watching and nothing else."""
    made = kopf.OperatorSettings()
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
    """Keep kopf from a line per object and event."""
    logging.getLogger("kopf.objects").setLevel(logging.WARNING)
    logging.getLogger("kopf").setLevel(logging.WARNING)


async def watch(see: See, access: Access, namespaces: Sequence[str]) -> None:
    """Watch until cancelled or told to stop by a signal."""
    await kopf.operator(
        registry=registry(see, access),
        settings=settings(),
        standalone=True,
        clusterwide=not namespaces,
        namespaces=list(namespaces),
    )
