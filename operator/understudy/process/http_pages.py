"""Small HTTP pages for probes and metrics, without the memory of a web framework."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping
from pathlib import Path

_logger = logging.getLogger(__name__)

PLAIN = "text/plain; charset=utf-8"
JSON, HTML = "application/json", "text/html; charset=utf-8"

Answer = tuple[int, str] | tuple[int, str | Path, str]
"""A status, a text or a file, and the content type if it is not plain text."""

Page = Callable[[], Answer]

_REASONS = {200: "OK", 404: "Not Found", 405: "Method Not Allowed", 503: "Service Unavailable"}
_TIMEOUT = 5.0  # seconds for a request to arrive
_PIECE = 1 << 18  # bytes of a file that are sent at once
_PATIENCE = 30.0  # seconds for the client to receive one of these pieces


async def serve(pages: Mapping[str, Page], port: int, *, host: str | None = "0.0.0.0") -> asyncio.Server:
    """Serve pages by path, for GET and HEAD, with one request per connection. Without a host: at all addresses, IPv6 too."""

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(_TIMEOUT):
                request = (await reader.readline()).decode("latin-1").split()
                while (await reader.readline()).strip():
                    pass
            answer: Answer
            if len(request) < 2 or request[0] not in ("GET", "HEAD"):
                answer = (405, "GET only\n")
            else:
                page = pages.get(request[1].split("?")[0])
                answer = page() if page else (404, "\n".join(sorted(pages)) + "\n")
            status, body, *kind = answer
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
            await writer.drain()
        except (TimeoutError, ConnectionError, ValueError):
            pass
        except Exception:
            _logger.exception("a page failed")
        finally:
            # A request that arrives while the process ends outlives the event loop.
            with contextlib.suppress(RuntimeError):
                writer.close()

    return await asyncio.start_server(handle, host, port, limit=16384)


async def _send(writer: asyncio.StreamWriter, path: Path) -> None:
    """Send a file in pieces: it may be larger than the memory that this process should use."""
    with await asyncio.to_thread(path.open, "rb") as file:
        while piece := await asyncio.to_thread(file.read, _PIECE):
            writer.write(piece)
            async with asyncio.timeout(_PATIENCE):
                await writer.drain()
