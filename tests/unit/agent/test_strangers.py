"""Connections to an agent that prove nothing, from other pods than the monitor's."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Iterator

import pytest

from tests.support.agents import IdleAgent
from understudy.agent.control_channel import ControlChannel
from understudy.api.protocol import secure_channel
from understudy.kube.agent_client import AgentLink
from understudy.process import connection_limits

Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@pytest.fixture
async def port() -> AsyncIterator[int]:
    """An agent's."""
    server = await ControlChannel(IdleAgent()).serve(0, host="0.0.0.0")
    yield server.sockets[0].getsockname()[1]
    server.close()


class Strangers:
    """Sessions that stay pending."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._writers: list[asyncio.StreamWriter] = []

    async def connect(self, address: str, times: int = 1) -> None:
        for _ in range(times):
            reader, writer = await asyncio.open_connection("127.0.0.1", self._port, local_addr=(address, 0))
            self._writers.append(writer)
            with contextlib.suppress(ConnectionError):
                await reader.readline()

    def close(self) -> None:
        for writer in self._writers:
            writer.transport.abort()


@pytest.fixture
def strangers(port: int) -> Iterator[Strangers]:
    made = Strangers(port)
    yield made
    made.close()


async def connected(port: int) -> Connection:
    """A monitor's connection, before it has proved anything."""
    return await asyncio.open_connection("127.0.0.1", port, local_addr=("127.0.0.1", 0))


async def assert_let_in(connection: Connection) -> None:
    """The monitor proves the token, and receives the status."""
    reader, writer = connection
    async with asyncio.timeout(5):
        channel = await secure_channel.connect(
            reader, writer, uid=IdleAgent.uid, secret=IdleAgent.proof, workload="w", claim=""
        )
        assert "status" in await channel.read()
    writer.close()


async def test_a_flood_from_one_pod_does_not_keep_the_monitor_out(port: int, strangers: Strangers) -> None:
    monitor = await connected(port)
    await strangers.connect("127.0.0.2", 2 * connection_limits.MOST)
    await assert_let_in(monitor)


async def test_a_flood_from_several_pods_does_not_keep_the_monitor_out(port: int, strangers: Strangers) -> None:
    most, most_of_one = connection_limits.MOST, connection_limits.MOST_OF_SOURCE
    pods = [f"127.0.0.{2 + number}" for number in range(most // most_of_one + 2)]
    for pod in pods:
        await strangers.connect(pod, most_of_one)
    monitor = await connected(port)
    for pod in pods:
        await strangers.connect(pod, most_of_one)
    await assert_let_in(monitor)


async def test_a_monitor_connects_during_a_flood(port: int, strangers: Strangers) -> None:
    flood = asyncio.create_task(strangers.connect("127.0.0.2", 10_000))
    link = AgentLink("127.0.0.1", port, IdleAgent.proof, "w", "", uid=IdleAgent.uid)
    try:
        await asyncio.sleep(0.2)
        await link.wait_connected(5)
        assert link.status is not None
    finally:
        flood.cancel()
        await link.close()


async def test_sessions_of_monitors_do_not_count_as_pending(port: int, strangers: Strangers) -> None:
    """A monitor may share its address with strangers, behind a network that translates addresses."""
    link = AgentLink("127.0.0.1", port, IdleAgent.proof, "w", "", uid=IdleAgent.uid)
    try:
        await link.wait_connected(5)
        await strangers.connect("127.0.0.1", 100)
        await asyncio.sleep(0.2)
        assert link.connected
    finally:
        await link.close()


async def test_connections_that_the_agent_has_not_accepted_yet_keep_nobody_out(port: int) -> None:
    """A flood may be faster than the agent accepts. The kernel then refuses the flood, and not the others."""
    with contextlib.ExitStack() as open_:
        for _ in range(connection_limits.MOST * 4):
            one = open_.enter_context(socket.socket())
            one.setblocking(False)
            one.bind(("127.0.0.2", 0))
            one.connect_ex(("127.0.0.1", port))
        # Nothing is accepted meanwhile: this blocks the event loop.
        open_.enter_context(socket.create_connection(("127.0.0.1", port), timeout=0.5, source_address=("127.0.0.1", 0)))
