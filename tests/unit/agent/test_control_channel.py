"""Requests that the network or a stalled process has held back."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Any, cast

import pytest

from tests.support.agents import IdleAgent
from understudy.agent.control_channel import ControlChannel, Operation, Peer
from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol.secure_channel import Channel, connect
from understudy.kube.agent_client import AgentGone, AgentLink


class Agent(IdleAgent):
    """An agent that counts what it carries out."""

    channel: ControlChannel

    def __init__(self) -> None:
        super().__init__()
        self.carried_out = self.port = 0

    def operations(self) -> Mapping[str, Operation]:
        async def probe(body: Mapping[str, Any], peer: Peer) -> None:
            self.carried_out += 1

        return {"probe": probe, "configure": probe}


class Monitor:
    """A monitor's side of a session, which sends what the test says."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    @classmethod
    async def of(cls, port: int) -> Monitor:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        secret, uid = IdleAgent.proof, IdleAgent.uid
        return cls(await connect(reader, writer, uid=uid, secret=secret, workload="robot", claim=""))

    async def status(self) -> int:
        """The number of the next status."""
        while "status" not in (message := await self._channel.read()):
            pass
        return int(message["number"])

    async def events(self) -> list[Any]:
        """The events that came before the next two statuses."""
        found: list[Any] = []
        statuses = 0
        while statuses < 2:
            message = await self._channel.read()
            statuses += "status" in message
            found += [message["event"]] if "event" in message else []
        return found

    async def ask(self, **words: Any) -> dict[str, Any]:
        self._channel.write({"id": 1, "op": "probe", **words})
        while "id" not in (message := await self._channel.read()):
            pass
        return message


@pytest.fixture
async def agent(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Agent]:
    monkeypatch.setattr(wire, "FRESH", 0.3)
    monkeypatch.setattr(wire, "STATUS_PERIOD", 0.05)
    served = Agent()
    served.channel = ControlChannel(served)
    server = await served.channel.serve(0, host="127.0.0.1")
    served.port = server.sockets[0].getsockname()[1]
    yield served
    server.close()


async def test_events_about_goals_reach_the_task_proxy_and_not_the_monitor(agent: Agent) -> None:
    """Nav2 gives feedback 100 times a second. Each message is encrypted, and woke the monitor."""
    proxy, monitor = await Monitor.of(agent.port), await Monitor.of(agent.port)
    await proxy.status()
    assert (await monitor.ask(op="configure", events=False, seen=await monitor.status()))["ok"]
    agent.channel.publish({"feedback": {"id": "goal"}})
    assert await proxy.events() == [{"feedback": {"id": "goal"}}]
    assert await monitor.events() == []


async def test_a_request_is_not_carried_out_if_its_sender_saw_nothing_of_the_agent_for_long(agent: Agent) -> None:
    monitor = await Monitor.of(agent.port)
    seen = await monitor.status()
    assert (await monitor.ask(seen=seen))["ok"]
    await asyncio.sleep(wire.FRESH + 0.1)
    refused = await monitor.ask(seen=seen)
    assert refused["heldBack"]
    assert "more than 0.3 s" in refused["error"]
    assert agent.carried_out == 1
    assert (await monitor.ask(seen=await monitor.status()))["ok"], "it may be sent again"


async def test_a_monitor_of_an_earlier_version_does_not_say_what_it_has_seen(agent: Agent) -> None:
    monitor = await Monitor.of(agent.port)
    await asyncio.sleep(wire.FRESH + 0.1)
    assert (await monitor.ask())["ok"]


async def test_a_request_that_was_held_back_counts_as_one_that_was_lost(
    agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = AgentLink("127.0.0.1", agent.port, IdleAgent.proof, "robot", "", uid=IdleAgent.uid)
    try:
        await link.wait_connected(5)
        await link.request("probe", {})
        monkeypatch.setattr(wire, "FRESH", -1.0)
        with pytest.raises(AgentGone, match="what its sender had seen last"):
            await link.request("probe", {})
    finally:
        await link.close()
    assert agent.carried_out == 1


async def test_a_connection_whose_other_side_is_gone_already_is_closed() -> None:
    closed = False

    class Gone:
        """The kernel does not know any more who it was."""

        transport = None

        def get_extra_info(self, name: str, default: Any = None) -> None:
            return None

        def close(self) -> None:
            nonlocal closed
            closed = True

    reader = asyncio.StreamReader()
    reader.feed_eof()
    await ControlChannel(Agent())._connected(reader, cast(Any, Gone()))
    assert closed
