"""Small HTTP pages for probes and metrics, without the memory of a web framework."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from understudy.process import connection_limits, source_queues
from understudy.process.connection_limits import ConnectionLimits

_logger = logging.getLogger(__name__)

PLAIN = "text/plain; charset=utf-8"
JSON, HTML = "application/json", "text/html; charset=utf-8"

Answer = tuple[int, str] | tuple[int, str | Path, str]
"""A status, a text or a file, and the content type if it is not plain text."""

Page = Callable[[], Answer]

_REFUSED: Answer = (405, "GET only\n")
_REASONS = {200: "OK", 404: "Not Found", 405: "Method Not Allowed", 503: "Service Unavailable"}
_TIMEOUT = 5.0  # seconds for a request to arrive
_MOST_BYTES = 16384  # of a request
_PIECE = 1 << 18  # bytes of a file that are sent at once
_PATIENCE = 30.0  # seconds for the client to receive an answer, or one of these pieces
_COSTLY = 0.001  # seconds of processor time
_REST = 9.0
"""Rest of a page after it was made, as a multiple of the time that it took: many requests for it take a tenth of the event
loop at most. A probe does not wait for another page's rest."""


async def serve(pages: Mapping[str, Page], port: int, *, host: str | None = "0.0.0.0") -> source_queues.Server:
    """Serve pages by path, for GET and HEAD, with one request per connection. Without a host: at all addresses, IPv6 too."""
    handle = _Server(pages).handle
    return await connection_limits.start_server(handle, host, port, limit=_MOST_BYTES, limits=ConnectionLimits())


class _Server:
    """Answers requests."""

    def __init__(self, pages: Mapping[str, Page]) -> None:
        self._pages = pages
        self._rests_until: dict[str, float] = {}
        """When a costly page may be made again, in monotonic seconds."""

    async def handle(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the request of one connection, and end it."""
        try:
            async with asyncio.timeout(_TIMEOUT):
                request = await _request(reader)
            path = request[1].split("?")[0] if len(request) > 1 else ""
            # The first of those that wait makes the page, and the others wait again.
            while (rest := self._rests_until.get(path, 0.0) - time.monotonic()) > 0:  # noqa: ASYNC110
                await asyncio.sleep(rest)
            if writer.is_closing():
                return
            status, body, *kind = self._answer(request[0], path) if path else _REFUSED
            size = body.stat().st_size if isinstance(body, Path) else len(body.encode())
            head = (
                f"HTTP/1.1 {status} {_REASONS.get(status, '')}\r\nContent-Type: {kind[0] if kind else PLAIN}\r\n"
                f"Content-Length: {size}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n"
            )
            writer.write(head.encode())
            if request[:1] == ["HEAD"]:
                pass
            elif isinstance(body, Path):
                await _send(writer, body)
            else:
                writer.write(body.encode())
            async with asyncio.timeout(_PATIENCE):
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, ConnectionError, ValueError):
            pass
        except Exception:
            _logger.exception("a page failed")
        finally:
            # A request that arrives while the process ends outlives the event loop.
            with contextlib.suppress(RuntimeError):
                writer.transport.abort()

    def _answer(self, method: str, path: str) -> Answer:
        if method not in ("GET", "HEAD"):
            return _REFUSED
        page = self._pages.get(path)
        if page is None:
            return 404, "\n".join(sorted(self._pages)) + "\n"
        # Processor time: on a busy node, the process may stand still meanwhile, and a probe must not wait for that.
        began = time.thread_time()
        try:
            return page()
        finally:
            if (took := time.thread_time() - began) > _COSTLY:
                self._rests_until[path] = time.monotonic() + _REST * took


async def _request(reader: asyncio.StreamReader) -> list[str]:
    """Return the words of a request's first line, after its headers. Raises ValueError if it is too long."""
    line = first = await reader.readline()
    left = _MOST_BYTES - len(first)
    while line.strip():
        line = await reader.readline()
        left -= len(line)
        if left < 0:
            raise ValueError(f"a request of more than {_MOST_BYTES} bytes")
    return first.decode("latin-1").split()


async def _send(writer: asyncio.StreamWriter, path: Path) -> None:
    """Send a file in pieces: it may be larger than the memory that this process should use."""
    with await asyncio.to_thread(path.open, "rb") as file:
        while piece := await asyncio.to_thread(file.read, _PIECE):
            writer.write(piece)
            async with asyncio.timeout(_PATIENCE):
                await writer.drain()
