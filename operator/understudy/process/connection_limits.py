"""Servers whose connections are limited, so that strangers neither keep others out nor use up the descriptors of the process.

A connection beyond a limit ends the oldest of the same source, or of the source that has most. A flood from one address so
ends its own connections, and a newcomer from another address is served. A flood that is faster than this process accepts is refused by the
kernel, in a queue of its own (source_queues.py).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import cast

from understudy.process import source_queues

MOST = 64
"""Connections in all."""

MOST_OF_SOURCE = 8
"""Connections of one address."""

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class ConnectionLimits:
    """The open connections that count against the limits."""

    def __init__(self, most: int = MOST, most_of_source: int = MOST_OF_SOURCE) -> None:
        self._most, self._most_of_source = most, most_of_source
        self._open: dict[str, dict[asyncio.WriteTransport, None]] = {}
        """The connections of each source, the oldest first."""

    def admit(self, transport: asyncio.WriteTransport) -> None:
        """Count a new connection. If there are too many, abort another one."""
        source = _source(transport)
        own = self._open.get(source, {})
        if len(own) >= self._most_of_source:
            self._abort_oldest(source)
        elif sum(map(len, self._open.values())) >= self._most:
            self._abort_oldest(max(self._open, key=lambda one: len(self._open[one])))
        self._open.setdefault(source, {})[transport] = None

    def release(self, transport: asyncio.WriteTransport) -> None:
        """Count a connection no longer: it has ended, or its other side is known. Can be repeated."""
        source = _source(transport)
        own = self._open.get(source, {})
        own.pop(transport, None)
        if not own:
            self._open.pop(source, None)

    def _abort_oldest(self, source: str) -> None:
        oldest = next(iter(self._open[source]))
        self.release(oldest)
        oldest.abort()


class _Protocol(asyncio.StreamReaderProtocol):
    """A connection that counts from the moment at which it is accepted."""

    def __init__(self, handler: Handler, limits: ConnectionLimits, limit: int) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(asyncio.StreamReader(limit=limit, loop=loop), handler, loop=loop)
        self._limits = limits
        self._counted: asyncio.WriteTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._counted = cast(asyncio.WriteTransport, transport)
        self._limits.admit(self._counted)
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._counted is not None:
            self._limits.release(self._counted)
        super().connection_lost(exc)


async def start_server(
    handler: Handler, host: str | None, port: int, *, limit: int, limits: ConnectionLimits
) -> source_queues.Server:
    """Listen as :func:`asyncio.start_server` does, with limits. ``limit`` is that of a stream's buffer. Raises OSError."""
    loop = asyncio.get_running_loop()

    def protocol() -> _Protocol:
        return _Protocol(handler, limits, limit)

    bound = await loop.create_server(protocol, host, port, start_serving=False)
    return source_queues.Server(protocol, bound)


def _source(transport: asyncio.WriteTransport) -> str:
    name = transport.get_extra_info("peername")
    return str(name[0]) if name else ""
