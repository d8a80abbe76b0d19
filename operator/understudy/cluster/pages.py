"""Small HTTP pages for probes and metrics, without the memory of a web framework."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

_logger = logging.getLogger(__name__)

Page = Callable[[], tuple[int, str]]
"""Answers with a status and a text."""

_REASONS = {200: "OK", 404: "Not Found", 405: "Method Not Allowed", 503: "Service Unavailable"}
_TIMEOUT = 5.0  # seconds for a request to arrive


async def serve(pages: Mapping[str, Page], port: int, *, host: str = "0.0.0.0") -> asyncio.Server:
    """Serve pages by path, for GET and HEAD, one request a connection."""

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(_TIMEOUT):
                request = (await reader.readline()).decode("latin-1").split()
                while (await reader.readline()).strip():
                    pass
            if len(request) < 2 or request[0] not in ("GET", "HEAD"):
                status, text = 405, "GET only\n"
            else:
                page = pages.get(request[1].split("?")[0])
                status, text = page() if page else (404, "\n".join(sorted(pages)) + "\n")
            body = text.encode()
            head = (
                f"HTTP/1.1 {status} {_REASONS.get(status, '')}\r\nContent-Type: text/plain; charset=utf-8\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
            )
            writer.write(head.encode() + (b"" if request[:1] == ["HEAD"] else body))
            await writer.drain()
        except (TimeoutError, ConnectionError, ValueError):
            pass
        except Exception:
            _logger.exception("a page failed")
        finally:
            writer.close()

    return await asyncio.start_server(handle, host, port, limit=16384)
