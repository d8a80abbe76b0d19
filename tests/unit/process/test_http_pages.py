"""Clients of the pages that are many, slow or endless."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from understudy.process import http_pages, source_queues
from understudy.process.connection_limits import MOST, MOST_OF_SOURCE

OPERATOR = Path(__file__).parents[3] / "operator"
REQUEST = b"GET %s HTTP/1.1\r\nHost: x\r\n\r\n"
LONG = "x" * (16 << 20)

OWN = source_queues.QUEUES + 20
"""Descriptors of the process itself, at most."""

SERVER = """
import asyncio, os, resource
from understudy.process.http_pages import serve
resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
pages = {"/descriptors": lambda: (200, str(len(os.listdir("/proc/self/fd"))))}
async def run():
    server = await serve(pages, 0)
    print(server.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()
asyncio.run(run())
"""


async def get(port: int, path: str = "/", *, source: str = "127.0.0.1", within: float = 5.0) -> bytes:
    """The body of a page."""
    async with asyncio.timeout(within):
        reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(source, 0))
        try:
            writer.write(REQUEST % path.encode())
            return (await reader.read()).partition(b"\r\n\r\n")[2]
        finally:
            writer.close()


@pytest.fixture
def process() -> Iterator[int]:
    """The port of a process that may have 256 descriptors."""
    command = [sys.executable, "-c", SERVER]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={"PYTHONPATH": str(OPERATOR)}) as running:
        assert running.stdout is not None
        yield int(running.stdout.readline())
        running.kill()


class Pages:
    """Pages of this process."""

    def __init__(self) -> None:
        self.made = 0
        self.port = 0

    def costly(self) -> tuple[int, str]:
        self.made += 1
        end = time.thread_time() + 0.02
        while time.thread_time() < end:
            pass
        return 200, "done"


@pytest.fixture
async def pages(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Pages]:
    monkeypatch.setattr(http_pages, "_PATIENCE", 0.5)
    made = Pages()
    server = await http_pages.serve(
        {"/": lambda: (200, "here"), "/long": lambda: (200, LONG), "/costly": made.costly}, 0, host="127.0.0.1"
    )
    made.port = server.sockets[0].getsockname()[1]
    yield made
    server.close()


async def test_many_open_connections_do_not_use_up_the_descriptors(process: int) -> None:
    kept = [
        await asyncio.open_connection("127.0.0.1", process, local_addr=(f"127.0.0.{2 + number % 20}", 0))
        for number in range(500)
    ]
    descriptors = int(await get(process, "/descriptors", source="127.0.0.99", within=3))
    assert descriptors < MOST + OWN
    for _, writer in kept:
        writer.close()


async def test_one_source_has_few_connections_and_its_newest_is_answered(process: int) -> None:
    kept = [await asyncio.open_connection("127.0.0.1", process, local_addr=("127.0.0.2", 0)) for _ in range(100)]
    assert int(await get(process, "/descriptors", source="127.0.0.2", within=3)) < MOST_OF_SOURCE + OWN
    for _, writer in kept:
        writer.close()


async def test_a_client_that_does_not_read_is_disconnected(pages: Pages) -> None:
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.setblocking(False)
    loop = asyncio.get_running_loop()
    await loop.sock_connect(client, ("127.0.0.1", pages.port))
    await loop.sock_sendall(client, REQUEST % b"/long")
    await asyncio.sleep(2)
    received = 0
    try:
        async with asyncio.timeout(20):
            while part := await loop.sock_recv(client, 1 << 20):
                received += len(part)
    except ConnectionResetError:
        pass
    finally:
        client.close()
    assert received < len(LONG)


async def test_a_client_that_reads_receives_a_long_page(pages: Pages) -> None:
    assert len(await get(pages.port, "/long", within=20)) == len(LONG)


async def test_a_request_with_endless_headers_is_ended_before_its_time(pages: Pages) -> None:
    async def send() -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", pages.port)
        writer.write(b"GET / HTTP/1.1\r\n")
        while True:
            writer.write(b"a: b\r\n" * 1000)
            await writer.drain()
            await asyncio.sleep(0.01)

    with pytest.raises(ConnectionError):
        await asyncio.wait_for(send(), 3)
    assert await get(pages.port) == b"here"


async def test_many_requests_for_a_costly_page_leave_most_of_the_event_loop_to_others(pages: Pages) -> None:
    async def ask() -> None:
        while True:
            await get(pages.port, "/costly")

    asking = [asyncio.create_task(ask()) for _ in range(MOST_OF_SOURCE - 1)]
    await asyncio.sleep(2)
    made = pages.made
    assert await get(pages.port, within=0.5) == b"here", "other pages do not wait for this one"
    for task in asking:
        task.cancel()
    assert 2 <= made <= 2 / (0.02 * 10) + 2
