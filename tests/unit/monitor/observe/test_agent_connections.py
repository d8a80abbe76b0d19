"""The monitor's connections to agents: the token that they use."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import sys
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.support.agents import PRIVATE_KEY, known_to_agent, known_to_monitor, old_session
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import ClusterObjects
from understudy.api import names
from understudy.api.protocol.agent_messages import AgentStatus, ProtocolError
from understudy.api.protocol.secure_channel import AuthenticationFailed, accept
from understudy.failover.interfaces import Instance
from understudy.kube.agent_client import AgentLink
from understudy.kube.client import SECRETS, ApiError
from understudy.kube.gates.base import Proof
from understudy.monitor.observe import agent_connections as module
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles

INSTANCE = Instance("w-1", "uid-1", ip="127.0.0.1", running=True, has_agent=True)
SECRET = names.agent_secret("w")


class Agent:
    """Lets in who knows its token, as an agent does."""

    def __init__(self, token: bytes) -> None:
        self.token = token
        self.refused = 0
        self.up_at: float | None = 1.0
        self.writers: list[asyncio.StreamWriter] = []

    async def session(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        with contextlib.suppress(ConnectionError):
            try:
                channel = await accept(reader, writer, uid=INSTANCE.uid, secret=lambda: known_to_agent(self.token))
            except AuthenticationFailed:
                self.refused += 1
                writer.close()
                return
            while True:
                status = AgentStatus("Running", True, process_up_at=self.up_at)
                channel.write({"status": status.to_wire()})
                await writer.drain()
                await asyncio.sleep(0.2)


def listens_at(server: asyncio.Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the agent of INSTANCE be at this server."""
    port = server.sockets[0].getsockname()[1]
    monkeypatch.setattr(sys.modules[__name__], "INSTANCE", replace(INSTANCE, agent_port=port))


@pytest.fixture
async def agent(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Agent]:
    made = Agent(b"second")
    server = await asyncio.start_server(made.session, "127.0.0.1", 0)
    listens_at(server, monkeypatch)
    yield made
    server.close()
    for writer in made.writers:
        writer.transport.abort()


async def eventually(check: Callable[[], object]) -> None:
    async with asyncio.timeout(25):
        while not check():
            await asyncio.sleep(0.01)


async def keep(client: MemoryClient, token: bytes) -> None:
    client.items.pop((SECRETS.plural, "fleet", SECRET), None)
    data = {
        names.TOKEN: base64.b64encode(token).decode(),
        names.MONITOR_PRIVATE_KEY: base64.b64encode(PRIVATE_KEY).decode(),
    }
    await client.create(SECRETS, "fleet", {"metadata": {"name": SECRET}, "data": data})


def reads(client: MemoryClient) -> int:
    return sum(method == "GET" for method, _, _ in client.requests)


class Trusted(Proof):
    """Notes whose packets are to count."""

    def __init__(self) -> None:
        self.signed: dict[str, list[bytes]] = {}
        self.unsigned: set[str] = set()

    def trust(self, uid: str, key: bytes) -> None:
        self.signed.setdefault(uid, []).append(key)

    def trust_unsigned(self, uid: str) -> None:
        self.unsigned.add(uid)


def connections(probes: Proof | None = None) -> tuple[MemoryClient, AgentConnections]:
    objects = ClusterObjects()
    client, roles = objects.client, InstanceRoles(objects.view, objects.gate, CurrentRecovery())
    probes = probes or Trusted()
    return client, AgentConnections(
        client, objects.view, "127.0.0.1", objects.crash_points, roles, objects.wakeups, probes
    )


async def test_a_recreated_secret_is_read_when_an_agent_refuses_the_token(
    agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "READ_AGAIN", 2.5, raising=False)
    client, agents = connections()
    await keep(client, b"first")
    agents.follow([INSTANCE])
    await eventually(lambda: agent.refused >= 2)
    assert reads(client) == 1, "not with each refusal"
    client.failing = lambda method, name: TimeoutError() if method == "GET" else None
    await eventually(lambda: reads(client) == 2)
    client.failing = lambda method, name: None
    assert await agents.secret(INSTANCE) == known_to_monitor(b"first"), "what was known stays, where it can't be read"
    await keep(client, b"second")
    async with asyncio.timeout(15):
        while agents.status(INSTANCE) is None:
            await asyncio.sleep(0.01)
    assert await agents.secret(INSTANCE) == known_to_monitor(b"second")
    agents.follow([])


async def test_an_agent_is_found_again_if_its_pod_has_another_address_after_its_node_restarted(agent: Agent) -> None:
    client, agents = connections()
    await keep(client, b"second")
    agents.follow([replace(INSTANCE, ip="127.0.0.77")])
    await asyncio.sleep(0.1)
    assert agents.status(INSTANCE) is None, "nobody listens there"
    agents.follow([INSTANCE])
    await eventually(lambda: agents.status(INSTANCE) is not None)
    agents.follow([])


async def test_who_waits_for_an_agent_goes_on_with_its_new_address(agent: Agent) -> None:
    """Its node lost power and came back, while a strategy waited for the processes (campaign 59)."""
    client, agents = connections()
    await keep(client, b"second")
    before = replace(INSTANCE, ip="127.0.0.77")
    agents.follow([before])
    waiting = asyncio.create_task(agents.up(before))
    await asyncio.sleep(0.1)
    assert not waiting.done(), "nobody listens there"
    agents.follow([INSTANCE])
    async with asyncio.timeout(5):
        assert await waiting > 0
    agents.follow([])


async def test_who_waits_for_a_report_of_an_agent_waits_for_that_of_its_new_address(agent: Agent) -> None:
    client, agents = connections()
    await keep(client, b"second")
    agent.up_at = None
    agents.follow([INSTANCE])
    waiting = asyncio.create_task(agents.up(INSTANCE))
    await eventually(lambda: agents.status(INSTANCE) is not None)
    agents.follow([replace(INSTANCE, ip="127.0.0.77")])
    await asyncio.sleep(0.1)
    agent.up_at = 1.0
    agents.follow([INSTANCE])
    async with asyncio.timeout(5):
        assert await waiting == 1.0
    agents.follow([])


async def test_a_connection_that_is_being_closed_when_it_is_made_is_not_configured(
    agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pod is gone, or has another address. The last report of the connection comes before its task has ended."""
    reports: list[Callable[[], None]] = []

    class Link(AgentLink):
        def __init__(self, *arguments: Any, on_change: Callable[[AgentLink], None], **named: Any) -> None:
            super().__init__(*arguments, on_change=on_change, **named)
            reports.append(lambda: on_change(self))

    monkeypatch.setattr(module, "AgentLink", Link)
    client, agents = connections()
    await keep(client, b"second")
    agents.follow([INSTANCE])
    await eventually(lambda: agents.status(INSTANCE) is not None)
    agents.follow([])
    reports[0]()


async def test_a_secret_that_cannot_be_read_is_requested_again_after_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    client, agents = connections()
    await keep(client, b"first")
    client.requests.clear()
    monkeypatch.setattr(module, "RETRY_API", 60.0)
    client.failing = lambda method, name: ApiError(429, "TooManyRequests", "later")
    assert [await agents.secret(INSTANCE) for _ in range(20)] == [None] * 20
    assert reads(client) == 1
    client.failing = lambda method, name: None
    monkeypatch.setattr(module, "RETRY_API", 0.0)
    assert await agents.secret(INSTANCE) == known_to_monitor(b"first")


async def test_a_caller_that_gives_up_does_not_end_the_connection_that_another_one_waits_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client, agents = connections()
    monkeypatch.setattr(client, "get", lambda *_: asyncio.sleep(60))  # the API server does not answer
    other = asyncio.create_task(agents.up(INSTANCE))
    for _ in range(2):
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await agents.up(INSTANCE)
    assert not other.done()
    other.cancel()


async def test_probes_of_an_instance_count_with_the_key_of_each_session(agent: Agent) -> None:
    probes = Trusted()
    client, agents = connections(probes)
    await keep(client, b"second")
    agents.follow([INSTANCE])
    await eventually(lambda: probes.signed)
    agent.writers[-1].transport.abort()
    await eventually(lambda: len(set(probes.signed[INSTANCE.uid])) == 2)
    assert not probes.unsigned
    agents.follow([])


async def test_probes_without_a_mac_count_only_of_a_pod_whose_agent_is_old(agent: Agent) -> None:
    probes = Trusted()
    _, agents = connections(probes)
    old = replace(INSTANCE, uid="uid-2", ip="127.0.0.77", agent_protocol=1, terminating=True)
    agents.follow([INSTANCE, old, replace(old, uid="uid-3", has_agent=False)])
    assert probes.unsigned == {"uid-2"}
    agents.follow([])


async def test_an_agent_of_another_pod_at_the_address_is_not_believed(agent: Agent) -> None:
    """The address of a pod that is gone may be another pod's, of the same workload and with the same token."""
    client, agents = connections()
    await keep(client, b"second")
    gone = replace(INSTANCE, name="w-0", uid="uid-0")
    agents.follow([gone])
    await eventually(lambda: agent.refused)
    assert agents.status(gone) is None
    agents.follow([])


async def test_an_old_agent_is_followed_where_its_pods_spec_says_that_it_is_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sessions: list[str] = []

    async def session(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        sessions.append("begun")
        with contextlib.suppress(ConnectionError, KeyError, ValueError, ProtocolError):
            await old_session(reader, writer, uid=INSTANCE.uid, token=b"second")

    server = await asyncio.start_server(session, "127.0.0.1", 0)
    listens_at(server, monkeypatch)
    client, agents = connections()
    await keep(client, b"second")
    agents.follow([INSTANCE])
    await eventually(lambda: len(sessions) >= 2)
    assert agents.status(INSTANCE) is None, "somebody answers for it"
    agents.follow([])
    old = replace(INSTANCE, agent_protocol=1)
    agents.follow([old])
    await eventually(lambda: agents.status(old) is not None)
    agents.follow([])
    server.close()
