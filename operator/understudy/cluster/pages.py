"""Small HTTP pages for probes and metrics, without the memory of a web framework."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

_logger = logging.getLogger(__name__)

PLAIN = "text/plain; charset=utf-8"
JSON, HTML = "application/json", "text/html; charset=utf-8"

Answer = tuple[int, str] | tuple[int, str, str]
"""A status, a text, and what that is where it isn't plain."""

Page = Callable[[], Answer]

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
            answer: Answer
            if len(request) < 2 or request[0] not in ("GET", "HEAD"):
                answer = (405, "GET only\n")
            else:
                page = pages.get(request[1].split("?")[0])
                answer = page() if page else (404, "\n".join(sorted(pages)) + "\n")
            status, text, *kind = answer
            body = text.encode()
            head = (
                f"HTTP/1.1 {status} {_REASONS.get(status, '')}\r\nContent-Type: {kind[0] if kind else PLAIN}\r\n"
                f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n"
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
