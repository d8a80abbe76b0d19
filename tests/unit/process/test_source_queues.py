"""The queues of connections that nobody has accepted yet. Over the loopback, whose addresses stand for pods."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import time
from collections.abc import AsyncIterator, Iterator

import pytest

from understudy.process import connection_limits, source_queues
from understudy.process.connection_limits import ConnectionLimits

FLOOD, OTHER = "127.0.0.2", "127.0.0.3"

PLENTY = 300
"""More connections than a queue holds."""


async def _hold(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        await reader.read()
    writer.close()


@pytest.fixture(params=["0.0.0.0", None], ids=["IPv4", "both"])
async def port(request: pytest.FixtureRequest) -> AsyncIterator[int]:
    """A port at which a server accepts nothing while the test does not let it."""
    with socket.socket() as free:
        free.bind(("0.0.0.0", 0))
        chosen: int = free.getsockname()[1]
    server = await connection_limits.start_server(_hold, request.param, chosen, limit=1024, limits=ConnectionLimits())
    yield chosen
    server.close()


@pytest.fixture
def connections() -> Iterator[contextlib.ExitStack]:
    """What a test keeps open."""
    with contextlib.ExitStack() as opened:
        yield opened


def _flood(connections: contextlib.ExitStack, port: int) -> None:
    for _ in range(PLENTY):
        one = connections.enter_context(socket.socket())
        one.setblocking(False)
        one.bind((FLOOD, 0))
        assert one.connect_ex(("127.0.0.1", port)) in (0, errno.EINPROGRESS)


def _connect(connections: contextlib.ExitStack, port: int, source: str) -> socket.socket:
    return connections.enter_context(socket.create_connection(("127.0.0.1", port), 0.3, source_address=(source, 0)))


async def test_a_flood_fills_a_queue_that_is_not_that_of_others(port: int, connections: contextlib.ExitStack) -> None:
    _flood(connections, port)
    _connect(connections, port, OTHER)
    with pytest.raises(TimeoutError):
        _connect(connections, port, FLOOD)


async def test_every_queue_is_served(port: int, connections: contextlib.ExitStack) -> None:
    for number in range(1, 2 * source_queues.QUEUES + 1):
        sock = _connect(connections, port, f"127.0.0.{number}")
        sock.shutdown(socket.SHUT_WR)
        sock.setblocking(False)
        async with asyncio.timeout(2):
            assert await asyncio.get_running_loop().sock_recv(sock, 1) == b"", "the server has read the end"


async def test_a_queue_that_is_never_empty_is_served_slowly(port: int) -> None:
    """So a flood costs little processor time, whatever its rate."""
    end, count = time.monotonic() + 1.0, 0
    while time.monotonic() < end:
        with contextlib.suppress(TimeoutError, ConnectionError):
            async with asyncio.timeout_at(asyncio.get_running_loop().time() + max(0.0, end - time.monotonic())):
                reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(FLOOD, 0))
                writer.write_eof()
                await reader.read()  # it was accepted
                count += 1
                writer.close()
    assert count <= source_queues.BACKLOG + 1.0 / source_queues.PACE + 1


async def test_others_do_not_wait_for_a_queue_that_is_served_slowly(
    port: int, connections: contextlib.ExitStack
) -> None:
    _flood(connections, port)
    await asyncio.sleep(0.1)
    begun = time.monotonic()
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(OTHER, 0))
    writer.write_eof()
    async with asyncio.timeout(2):
        assert await reader.read() == b"", "it was accepted"
    assert time.monotonic() - begun < 1.0
    writer.close()


async def test_connections_over_ipv6(connections: contextlib.ExitStack) -> None:
    server = await connection_limits.start_server(_hold, "::1", 0, limit=1024, limits=ConnectionLimits())
    for _ in range(3):
        connections.enter_context(socket.create_connection(server.sockets[0].getsockname()[:2], 0.3))
    server.close()


async def test_a_port_that_another_process_has_is_an_error(port: int) -> None:
    with pytest.raises(OSError, match="in use"):
        await connection_limits.start_server(_hold, "0.0.0.0", port, limit=1024, limits=ConnectionLimits())


async def test_a_kernel_without_several_sockets_at_a_port_has_one_queue(
    monkeypatch: pytest.MonkeyPatch, connections: contextlib.ExitStack
) -> None:
    monkeypatch.setattr(socket, "SO_REUSEPORT", 9999)
    server = await connection_limits.start_server(_hold, "127.0.0.1", 0, limit=1024, limits=ConnectionLimits())
    assert len(server.sockets) == 1
    _connect(connections, server.sockets[0].getsockname()[1], OTHER)
    server.close()
