"""Each end of a session proves the token, for this pod alone, and every line after that is authentic. Real ends, over the loopback."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any

import pytest

from tests.support.agents import PUBLIC_KEY, IdleAgent, old_session
from understudy.agent.control_channel import ControlChannel, Operation, Peer
from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import monitor_key
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.secure_channel import AgentSecret, MonitorSecret
from understudy.api.protocol.session_keys import derive, legacy_proof
from understudy.kube.agent_client import AgentGone, AgentLink, AgentRefused

STATUS = {"status": AgentStatus("Running", True).to_wire(), "number": 1}

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
Meddle = Callable[[list[bytes]], list[bytes]]
"""What arrives instead of three lines that are sent."""


class Agent(IdleAgent):
    """An agent that notes what it carries out."""

    def __init__(self) -> None:
        super().__init__()
        self.carried_out: list[int] = []
        self.channel = ControlChannel(self)

    def operations(self) -> Mapping[str, Operation]:
        async def go(body: Mapping[str, Any], peer: Peer) -> None:
            self.carried_out.append(body["number"])

        return {"go": go}


class Meddler:
    """Somebody between a monitor and an agent. In the first session, each direction may have three lines of one kind meddled with."""

    def __init__(
        self, port: int, *, marker: bytes = b"", to_agent: Meddle | None = None, to_monitor: Meddle | None = None
    ) -> None:
        self._port, self._marker, self._meddles = port, marker, (to_agent, to_monitor)
        self.seen: list[bytes] = []
        """The lines that have passed."""

    async def session(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        beyond, onwards = await asyncio.open_connection("127.0.0.1", self._port)
        meddles, self._meddles = self._meddles, (None, None)
        pumps = (self._pump(reader, onwards, meddles[0]), self._pump(beyond, writer, meddles[1]))
        await asyncio.wait([asyncio.ensure_future(pump) for pump in pumps], return_when=asyncio.FIRST_COMPLETED)
        for end in (writer, onwards):
            end.close()

    async def _pump(self, source: asyncio.StreamReader, target: asyncio.StreamWriter, meddle: Meddle | None) -> None:
        held: list[bytes] = []
        with contextlib.suppress(OSError):
            while line := await source.readline():
                self.seen.append(line)
                if meddle is not None and self._marker in line:
                    held.append(line)
                    if len(held) == 3:
                        target.write(b"".join(meddle(held)))
                else:
                    target.write(line)


@pytest.fixture
async def serve() -> AsyncIterator[Callable[[Handler], Awaitable[int]]]:
    servers: list[asyncio.Server] = []

    async def begin(handler: Handler) -> int:
        servers.append(await asyncio.start_server(handler, "127.0.0.1", 0))
        port: int = servers[-1].sockets[0].getsockname()[1]
        return port

    yield begin
    for server in servers:
        server.close()


@pytest.fixture
async def agent() -> AsyncIterator[tuple[Agent, int]]:
    made = Agent()
    server = await made.channel.serve(0, host="127.0.0.1")
    yield made, server.sockets[0].getsockname()[1]
    server.close()


@pytest.fixture
async def link() -> AsyncIterator[Callable[..., AgentLink]]:
    links: list[AgentLink] = []

    def connect(port: int, uid: str = IdleAgent.uid, **more: Any) -> AgentLink:
        links.append(AgentLink("127.0.0.1", port, IdleAgent.proof, "robot", "", uid=uid, **more))
        return links[-1]

    yield connect
    for made in links:
        await made.close()


async def eventually(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(20):
        while not holds():
            await asyncio.sleep(0.01)


async def test_a_proof_for_one_agent_is_of_no_use_at_another(agent: tuple[Agent, int], serve: Any, link: Any) -> None:
    other, port = agent
    between = Meddler(port)
    confused = link(await serve(between.session), uid="another pod")
    with pytest.raises(AgentGone, match="the monitor means another pod"):
        await confused.wait_connected(1.0)
    assert confused.status is None
    assert other.channel.count == 0


async def test_the_greeting_does_not_name_the_pod(agent: tuple[Agent, int]) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", agent[1])
    assert wire.decode(await reader.readline()).keys() == {"nonce", "version", "versions", "key"}
    writer.close()


@pytest.mark.parametrize("proof", ["guessed", "reflected", "none"])
async def test_a_monitor_believes_nobody_who_does_not_know_the_token(serve: Any, link: Any, proof: str) -> None:
    received: list[bytes] = []

    async def pretend(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonce = "2:" + secrets.token_hex(16)
        greeting = {"nonce": nonce, "version": 1, "versions": [1, 2, 3], "key": PUBLIC_KEY.hex(), "uid": IdleAgent.uid}
        writer.write(wire.encode(greeting))
        answer = wire.decode(await reader.readline())
        if proof != "none":
            writer.write(wire.encode({"mac": answer["mac"] if proof == "reflected" else secrets.token_hex(32)}))
        writer.write(wire.encode(STATUS))
        received.append(await reader.read())

    stranger = link(await serve(pretend))
    with pytest.raises(AgentGone, match="does not prove that it is the pod's agent"):
        await stranger.wait_connected(1.0)
    assert (stranger.status, stranger.sessions) == (None, 0)
    with pytest.raises(AgentGone):
        await stranger.request("go", {"number": 1})
    assert not any(received), "nothing was sent to it"


async def test_a_refusal_from_a_stranger_is_not_taken_for_more_than_a_reason(serve: Any, link: Any) -> None:
    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        greeting = {"nonce": "2:n", "versions": [3], "key": PUBLIC_KEY.hex()}
        writer.write(wire.encode(greeting) + wire.encode({"error": "x" * 3000}))

    stranger = link(await serve(refuse))
    await eventually(lambda: stranger.refused)
    assert len(stranger.problem) == 300


FORGED = b'{"id":7,"op":"go","number":9,"event":{"number":9}}\n'

MEDDLING: dict[str, tuple[Meddle, list[int]]] = {
    "untouched": (lambda lines: lines, [1, 2, 3]),
    "changed": (lambda lines: [lines[0], lines[1].replace(b'"number":2', b'"number":9'), lines[2]], [1]),
    "repeated": (lambda lines: [lines[0], *lines], [1]),
    "dropped": (lambda lines: lines[1:], []),
    "reordered": (lambda lines: [lines[0], lines[2], lines[1]], [1]),
    "inserted": (lambda lines: [lines[0], FORGED, *lines[1:]], [1]),
    "without MAC": (lambda lines: [line[line.index(b"{") :] for line in lines], []),
}


@pytest.mark.parametrize("name", MEDDLING)
async def test_a_request_that_is_not_authentic_ends_the_session(
    agent: tuple[Agent, int], serve: Any, link: Any, name: str
) -> None:
    meddle, expected = MEDDLING[name]
    served, port = agent
    monitor = link(await serve(Meddler(port, marker=b'"op":"go"', to_agent=meddle).session))
    await monitor.wait_connected(20)
    asking = [asyncio.ensure_future(monitor.request("go", {"number": n})) for n in (1, 2, 3)]
    answers = await asyncio.gather(*asking, return_exceptions=True)
    if name == "untouched":
        assert served.carried_out == expected
    else:
        assert served.carried_out in ([], expected), "the end of a session cancels what is not carried out yet"
        assert isinstance(answers[-1], AgentGone)
        await eventually(lambda: monitor.sessions == 2)


@pytest.mark.parametrize("name", MEDDLING)
async def test_an_event_that_is_not_authentic_ends_the_session(
    agent: tuple[Agent, int], serve: Any, link: Any, name: str
) -> None:
    meddle, expected = MEDDLING[name]
    served, port = agent
    received: list[int] = []
    between = Meddler(port, marker=b'"event"', to_monitor=meddle)
    monitor = link(await serve(between.session), on_event=lambda _, event: received.append(event["number"]))
    await monitor.wait_connected(20)
    await eventually(lambda: served.channel.count == 1)
    for number in (1, 2, 3):
        served.channel.publish({"number": number})
    await eventually(lambda: received == [1, 2, 3] if name == "untouched" else monitor.sessions == 2)
    assert received == expected
    if name == "changed":
        assert b'"number":9' not in b"".join(between.seen), "the meddler changed it"


async def test_a_refusal_after_the_proofs_is_authentic(agent: tuple[Agent, int], link: Any) -> None:
    served, port = agent
    served.refuses = lambda workload, claim: "claimed by another"  # type: ignore[method-assign]
    with pytest.raises(AgentGone, match="claimed by another"):
        await link(port).wait_connected(1.0)


async def old_agent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await old_session(reader, writer, uid=IdleAgent.uid, token=IdleAgent.token)


async def test_an_old_agent_is_accepted_where_its_pod_says_that_it_is_old(serve: Any, link: Any) -> None:
    old = link(await serve(old_agent), protocol=1)
    await old.wait_connected(20)
    assert (await old.request("go", {}))["ok"]
    assert old.probe_key == b""


async def test_an_agent_cannot_be_older_than_its_pod_says(serve: Any, link: Any) -> None:
    old = link(await serve(old_agent))
    with pytest.raises(AgentGone, match="greets with protocol version 1, but its pod's spec names version 2"):
        await old.wait_connected(1.0)
    assert old.sessions == 0


async def test_an_agent_of_another_pod_is_not_taken_for_an_old_one(serve: Any, link: Any) -> None:
    old = link(await serve(old_agent), uid="another pod", protocol=1)
    with pytest.raises(AgentGone, match="agent of another pod"):
        await old.wait_connected(1.0)


async def test_an_agent_that_is_newer_than_its_pod_says_is_authenticated(agent: tuple[Agent, int], link: Any) -> None:
    newer = link(agent[1], protocol=1)
    await newer.wait_connected(20)
    assert newer.probe_key


async def test_who_answers_for_an_old_agent_gets_no_proof_for_a_new_one(
    agent: tuple[Agent, int], serve: Any, link: Any
) -> None:
    """The pod at one address is old, and somebody there relays the greeting of a new agent as if it were an old one's."""
    served, port = agent

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        beyond, onwards = await asyncio.open_connection("127.0.0.1", port)
        greeting = wire.decode(await beyond.readline())
        writer.write(wire.encode({"nonce": greeting["nonce"], "version": 1, "uid": IdleAgent.uid}))
        onwards.write(await reader.readline())
        writer.write(await beyond.readline())
        onwards.close()

    confused = link(await serve(relay), protocol=1)
    with pytest.raises(AgentGone, match="relays the greeting of another agent"):
        await confused.wait_connected(1.0)
    assert served.channel.count == 0


async def test_a_monitor_of_an_earlier_version_commands_an_agent(agent: tuple[Agent, int]) -> None:
    """After a rollback, once the operator of that version has written another Secret: the active instance keeps its agent."""
    served, port = agent
    served.secret = lambda: AgentSecret(IdleAgent.token)  # type: ignore[method-assign]
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    greeting = wire.decode(await reader.readline())
    assert greeting["version"] == 1, "it accepts no other"
    proof = legacy_proof(IdleAgent.token, greeting["nonce"], "robot", "")
    writer.write(wire.encode({"workload": "robot", "claim": "", "mac": proof}))
    assert "status" in wire.decode(await reader.readline())
    writer.write(wire.encode({"id": 1, "op": "go", "number": 1}))
    assert wire.decode(await reader.readline())["ok"]
    assert served.carried_out == [1]
    writer.close()


def sibling(version: int, greeting: dict[str, Any]) -> dict[str, Any]:
    """What whoever controls another agent with the same Secret answers to a greeting: it has all that the pod mounts."""
    nonce, other = greeting["nonce"], secrets.token_hex(16)
    if version == 1:
        return {"workload": "robot", "claim": "", "mac": legacy_proof(IdleAgent.token, nonce, "robot", "")}
    own, shared = monitor_key.AgentSide(PUBLIC_KEY), b""
    if version == 3:
        shared = own.shared
    keys = derive(
        IdleAgent.token,
        uid=IdleAgent.uid,
        agent_nonce=nonce,
        monitor_nonce=other,
        workload="robot",
        claim="",
        shared=shared,
    )
    return {"version": version, "nonce": other, "workload": "robot", "claim": "", "mac": keys.monitor_proof}


@pytest.mark.parametrize("version", [1, 2, 3])
async def test_whoever_controls_another_agent_with_the_same_token_commands_none(
    agent: tuple[Agent, int], version: int
) -> None:
    served, port = agent
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    greeting = wire.decode(await reader.readline())
    writer.write(wire.encode(sibling(version, greeting)))
    answer = wire.decode(await reader.readline())
    assert "authentication failed" in answer["error"] or "does not prove that it has its key" in answer["error"]
    assert await reader.read() == b""
    assert (served.channel.count, served.carried_out) == (0, [])
    writer.close()


async def test_an_agent_whose_secret_has_no_key_of_the_monitor_yet_is_commanded(
    agent: tuple[Agent, int], link: Any
) -> None:
    """The operator writes it once the monitor reports that it knows such keys, and the kubelet copies it later still."""
    served, port = agent
    served.secret = lambda: AgentSecret(IdleAgent.token)  # type: ignore[method-assign]
    before = link(port)
    await before.wait_connected(20)
    assert (await before.request("go", {"number": 1}))["ok"]
    assert before.probe_key, "its lines and its test packets are authenticated by the token"


async def test_a_monitor_without_a_key_reads_its_secret_again(agent: tuple[Agent, int], link: Any) -> None:
    keyless = link(agent[1])
    keyless.secret = MonitorSecret(IdleAgent.token)
    await eventually(lambda: keyless.refused)
    assert "it reads its Secret again" in keyless.problem
    keyless.secret = IdleAgent.proof
    await keyless.wait_connected(20)


async def test_an_agent_with_an_invalid_key_of_the_monitor_says_how_to_replace_it(
    agent: tuple[Agent, int], link: Any
) -> None:
    served, port = agent
    served.secret = lambda: AgentSecret(IdleAgent.token, b"short")  # type: ignore[method-assign]
    with pytest.raises(AgentGone, match="delete the Secret"):
        await link(port).wait_connected(1.0)


async def test_a_proof_of_a_later_version_is_none_of_version_1(agent: tuple[Agent, int], serve: Any, link: Any) -> None:
    """Somebody between a monitor and its agent makes a session without line authentication of it."""
    served, port = agent

    async def downgrade(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        beyond, onwards = await asyncio.open_connection("127.0.0.1", port)
        writer.write(await beyond.readline())
        answer = wire.decode(await reader.readline())
        onwards.write(wire.encode({name: answer[name] for name in ("workload", "claim", "mac")}))
        writer.write(await beyond.readline())
        onwards.close()

    confused = link(await serve(downgrade))
    with pytest.raises(AgentGone, match="does not prove that it has its key"):
        await confused.wait_connected(1.0)
    assert served.channel.count == 0
    with pytest.raises((AgentGone, AgentRefused)):
        await confused.request("go", {"number": 1})
