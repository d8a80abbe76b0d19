"""The monitor's end of the control channel, against agents that misbehave; tests/unit/agent has a real one."""

import asyncio
import contextlib
import gc
import time

import pytest

from tests.support.agents import known_to_agent, known_to_monitor, status_of
from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol.agent_messages import AgentStatus, GateEpoch, OutputCount, ProtocolError
from understudy.api.protocol.secure_channel import accept
from understudy.kube.agent_client import AgentGone, AgentLink, AgentRefused

TOKEN = b"token"
OUTPUTS, INTERFACES = {"/cmd_vel": OutputCount(5, 4.0)}, {"net1": ("192.168.7.2", "fd12::2")}
STATUS = AgentStatus(
    "Running", True, "", 1.0, 2.0, 3.0, True, OUTPUTS, further_interfaces=INTERFACES, gate=GateEpoch("u", 3)
)


class Agent:
    """Speaks the protocol. The test defines what follows the greeting."""

    def __init__(self):
        self.follow = None
        self.sessions = 0
        self.greeting = None
        self.server = None
        self._writers = []

    async def serve(self, port=0):
        self.server = await asyncio.start_server(self._session, "127.0.0.1", port)
        self.port = self.server.sockets[0].getsockname()[1]

    async def close(self):
        self.server.close()
        for writer in self._writers:
            writer.transport.abort()

    async def _session(self, reader, writer):
        self._writers.append(writer)
        self.sessions += 1
        with contextlib.suppress(ConnectionError, EOFError):
            if self.greeting is not None:
                writer.write(wire.encode(self.greeting))
                return
            channel = await accept(reader, writer, uid="u", secret=lambda: known_to_agent(TOKEN))
            await self.follow(channel, writer)


async def say(channel, status=STATUS):
    channel.write({"status": status.to_wire()})


async def send_forever(channel, writer):
    while True:
        await say(channel)
        await asyncio.sleep(0.5)


@pytest.fixture
async def agent():
    made = Agent()
    made.follow = send_forever
    await made.serve()
    yield made
    await made.close()


@pytest.fixture
def changes():
    """Whether there was a connection, at each change of the link."""
    return []


@pytest.fixture
async def link(agent, changes):
    made = AgentLink(
        "127.0.0.1",
        agent.port,
        known_to_monitor(TOKEN),
        "robot",
        "uid/1",
        uid="u",
        pod="p",
        on_change=lambda changed: changes.append(changed.connected),
    )
    yield made
    await made.close()


def test_a_status_is_unchanged_by_encoding_and_decoding():
    assert AgentStatus.from_wire(wire.decode(wire.encode(STATUS.to_wire()))) == STATUS
    assert AgentStatus.from_wire({"phase": "Held", "ready": False, "newer": 1}) == AgentStatus()


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"phase": "Held"},
        {"phase": "Held", "ready": 1, "outputs": {"/x": 1}},
        {"phase": "Held", "ready": 1, "furtherInterfaces": ["net1"]},
    ],
)
def test_an_invalid_status_is_refused(data):
    with pytest.raises(ProtocolError, match="not a status"):
        AgentStatus.from_wire(data)


@pytest.mark.parametrize("line", [b"", b"x", b"[]", b"1", b"[" * 100_000, b"\xff"])
def test_invalid_data_is_refused(line):
    with pytest.raises(ProtocolError):
        wire.decode(line)


def test_a_message_that_is_too_long_is_not_sent():
    with pytest.raises(ProtocolError, match="33554432"):
        wire.encode({"tree": "x" * wire.MAX_LINE})


async def test_the_link_connects_and_receives_the_status(link):
    assert not link.connected
    await link.wait_connected(2)
    assert link.status == STATUS
    assert link.problem == ""
    assert await link.wait_for(lambda s: s.ready, 1) == STATUS


async def test_the_link_connects_as_soon_as_an_agent_listens(agent):
    await agent.close()
    await agent.server.wait_closed()
    link = AgentLink("127.0.0.1", agent.port, known_to_monitor(TOKEN), "robot", "", uid="u")
    with pytest.raises(AgentGone, match="Connection refused"):
        await link.wait_connected(0.3)
    await agent.serve(agent.port)
    started_at = time.monotonic()
    await link.wait_connected(3)
    assert time.monotonic() - started_at < 1.2
    await link.close()


async def test_a_lost_connection_fails_pending_requests_at_once(agent, link):
    async def die(channel, writer):
        await say(channel)
        await channel.read()
        writer.transport.abort()

    agent.follow = die
    await link.wait_connected(2)
    started_at = time.monotonic()
    with pytest.raises(AgentGone):
        await link.start({"app": {"A": "1"}}, {})
    assert time.monotonic() - started_at < 0.5
    agent.follow = send_forever
    await link.wait_connected(2)
    assert agent.sessions >= 2


async def test_a_connection_lost_while_a_request_is_sent_leaves_no_traceback(agent, link, monkeypatch):
    reported = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: reported.append(context["message"]))
    await link.wait_connected(2)
    drain = asyncio.StreamWriter.drain

    async def lose(writer):
        """The connection ends while the request is written, and the link notices that before the request does."""
        monkeypatch.setattr(asyncio.StreamWriter, "drain", drain)
        writer.transport.abort()
        while link.connected:
            await asyncio.sleep(0)
        raise ConnectionResetError

    monkeypatch.setattr(asyncio.StreamWriter, "drain", lose)
    with pytest.raises(AgentGone):
        await link.request("start", {})
    gc.collect()
    await asyncio.sleep(0)
    assert not reported


async def test_a_silent_agent_counts_as_disconnected(agent, link, changes, monkeypatch):
    monkeypatch.setattr(wire, "SILENCE", 0.3)

    async def fall_silent(channel, writer):
        await say(channel)
        await asyncio.sleep(60)

    agent.follow = fall_silent
    await link.wait_connected(2)
    asking = asyncio.create_task(status_of(link))
    with pytest.raises(AgentGone, match="lost"):
        await asking
    assert (link.connected, link.status) == (False, None)
    assert link.problem == "silent for 0.3 s"
    assert changes[:2] == [True, False]


async def test_what_was_not_delivered_is_discarded_when_the_connection_is_lost(agent, link, monkeypatch):
    monkeypatch.setattr(wire, "SILENCE", 0.3)
    ended = asyncio.get_running_loop().create_future()

    async def hear_nothing(channel, writer):
        await say(channel)
        await asyncio.sleep(1)
        try:
            while await channel.read():
                pass
        except EOFError:
            ended.set_result("an end, after all that was sent")
        except ConnectionResetError:
            ended.set_result("a reset")

    agent.follow = hear_nothing
    assert await asyncio.wait_for(ended, 5) == "a reset"


async def test_a_refusal_is_reported(agent, link):
    async def refuse(channel, writer):
        channel.write({"error": "claimed by other"})
        await writer.drain()
        writer.close()

    agent.follow = refuse
    with pytest.raises(AgentGone, match="claimed by other"):
        await link.wait_connected(0.3)
    with pytest.raises(AgentGone, match="claimed by other"):
        await status_of(link)
    assert agent.sessions == 1


async def test_an_error_is_an_answer_to_its_request(agent, link):
    async def answer(channel, writer):
        await say(channel)
        while True:
            request = await channel.read()
            await say(channel)
            if request["op"] == "status":
                channel.write({"id": request["id"], "ok": True, "status": STATUS.to_wire()})
            else:
                channel.write({"id": request["id"], "error": "no"})

    agent.follow = answer
    await link.wait_connected(2)
    asked, refused = await asyncio.gather(status_of(link), link.request("probe", {}), return_exceptions=True)
    assert asked == STATUS
    assert isinstance(refused, AgentRefused)
    assert "probe: no" in str(refused)


@pytest.mark.parametrize("data", [b"x\n", b"[]\n", b'{"status": 1}\n', b"\xff\n", b"x" * (2 << 20)])
async def test_invalid_data_ends_the_session_but_not_the_link(agent, link, data):
    async def talk(channel, writer):
        await say(channel)
        writer.write(data)
        agent.follow = send_forever
        await asyncio.sleep(60)

    agent.follow = talk
    async with asyncio.timeout(5):
        while not (agent.sessions > 1 and link.connected):
            await asyncio.sleep(0.01)


async def test_an_answer_without_a_request_is_ignored(agent, link):
    async def talk(channel, writer):
        await say(channel)
        for number in (99, "x", [], None):
            channel.write({"id": number, "ok": True})
        await send_forever(channel, writer)

    agent.follow = talk
    await link.wait_connected(2)
    await asyncio.sleep(0.7)
    assert link.connected
    assert agent.sessions == 1


async def test_another_protocol_version_is_reported(agent, link):
    agent.greeting = {"nonce": "n", "version": 9}
    with pytest.raises(AgentGone, match="the agent greets with protocol version 9"):
        await link.wait_connected(0.5)


async def test_wait_for_reports_the_last_state_when_it_times_out(link):
    with pytest.raises(TimeoutError, match=r"agent p: not within 0\.5 s: Running"):
        await link.wait_for(lambda s: s.phase == "Held", 0.5)


async def test_a_listener_that_fails_does_not_end_the_link(agent):
    def fail(link):
        raise RuntimeError("listener")

    link = AgentLink("127.0.0.1", agent.port, known_to_monitor(TOKEN), "robot", "", uid="u", on_change=fail)
    await link.wait_connected(2)
    await asyncio.sleep(0.7)
    assert link.connected
    await link.close()


async def test_close_ends_the_link(agent, link):
    await link.wait_connected(2)
    asking = asyncio.create_task(status_of(link))
    await asyncio.sleep(0)
    await link.close()
    with pytest.raises(AgentGone):
        await asking
    assert not link.connected
