"""Repeats requests that the API server did not answer: one rule for all that a recovery cannot do without."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from understudy.kube.client import FAILURES, ApiError

RETRY_FIRST, RETRY_MOST = 0.05, 0.25  # seconds; an executing standby drives so soon after the API server is back

TRY_WITHIN = 2.0
"""Seconds after which a request without an answer is sent again, over a new connection."""

T = TypeVar("T")


async def answered(ask: Callable[[], Awaitable[T]], *, within: float | None = TRY_WITHIN) -> T:
    """Return the API server's answer, repeating the request until there is one.

    ``within`` are the seconds that one try has; None for the client's own limit, for an answer that may be long. Raises ApiError if the API
    server refuses.
    """
    retry = RETRY_FIRST
    while True:
        try:
            async with asyncio.timeout(within):
                return await ask()
        except FAILURES as error:
            if not unanswered(error):
                raise
            await asyncio.sleep(retry)
            retry = min(2 * retry, RETRY_MOST)


def unanswered(error: Exception) -> bool:
    """Whether it is unknown if a request was carried out, or the request is worth repeating."""
    return not isinstance(error, ApiError) or not error.final
