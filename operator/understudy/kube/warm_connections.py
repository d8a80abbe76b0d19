"""Keeps connections to the API server open, so that they are ready when they are needed.

An API server closes a connection that was not used for 90 s (Kubernetes' IdleTimeout). A monitor at rest only watches,
so each recovery had to open new ones: three round trips, and some milliseconds of a processor on both sides for TLS.
"""

from __future__ import annotations

import asyncio

from understudy.kube.client import FAILURES, Client

EVERY = 60.0
"""Seconds between two uses. Load balancers in front of an API server often close idle connections after minutes, and hardly any after less
than one.
"""

COUNT = 2
"""Connections that a recovery uses at the same time: it closes the gate while it claims a pod."""


async def keep_warm(client: Client, count: int = COUNT, *, every: float = EVERY) -> None:
    """Use ``count`` connections of a client every ``every`` seconds, until cancelled."""
    while True:
        await asyncio.gather(*(_use(client) for _ in range(count)))
        await asyncio.sleep(every)


async def _use(client: Client) -> None:
    try:
        await client.read("/version")
    except FAILURES:
        return  # a refusal also keeps the connection; callers that need the API server report its absence
