"""Connections to the API server that are there when they are needed.

An API server closes one that nobody has used for 90 s (Kubernetes' IdleTimeout). A monitor at rest only watches, so each recovery began
with new ones: three ways there and back, and some milliseconds of a processor on both sides for TLS.
"""

from __future__ import annotations

import asyncio

import aiohttp

from understudy.kube.client import ApiError, Client

EVERY = 60.0
"""Seconds between two uses; load balancers before an API server often wait for minutes, and hardly any for less than one."""

COUNT = 2
"""Connections that a recovery uses at a time: the gate is closed while a pod is claimed."""


async def keep_warm(client: Client, count: int = COUNT, *, every: float = EVERY) -> None:
    """Use so many connections of a client once in a while, until cancelled."""
    while True:
        await asyncio.gather(*(_use(client) for _ in range(count)))
        await asyncio.sleep(every)


async def _use(client: Client) -> None:
    try:
        await client.read("/version")
    except (ApiError, aiohttp.ClientError, TimeoutError, OSError):
        return  # a refusal serves as well, and who needs the API server tells that it's away
