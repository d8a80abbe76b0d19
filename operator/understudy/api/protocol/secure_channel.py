"""The beginning of a session between a monitor and an agent, and the authenticated lines after it. Both ends use this module.

The agent speaks first: ``{"nonce", "version": 1, "versions": [1, 2]}``. The monitor answers ``{"version": 2, "nonce", "workload",
"claim", "mac"}``. If the MAC is right, the agent answers ``{"mac"}``, and the monitor believes nothing before it has verified that. From
then on each line is authenticated (session_keys.py). The agent does not send its pod's UID: the monitor knows it from the API server, and
the MACs include it. So what one agent sends is of no use at another one.

Version 1 has only the MAC of the monitor, without the UID, and plain lines. The monitor speaks it only with pods of which the Kubernetes
API says that their agent is that old. An agent accepts it from the monitors of an earlier version, during an upgrade and after a rollback.
Nobody can use the first to attack the second: an agent that knows version 2 uses nonces for which a monitor that knows version 2 makes
no proof of version 1.
"""

from __future__ import annotations

import asyncio
import re
import secrets
from collections.abc import Callable, Mapping
from typing import Any

from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import session_keys
from understudy.api.protocol.agent_messages import OLDEST_PROTOCOL, PROTOCOL, ProtocolError
from understudy.api.protocol.session_keys import LineAuthentication, NotAuthentic, SessionKeys

BUFFER = 1 << 16
"""Limit of the stream readers in bytes. Longer lines are read in parts, so that each end decides how long a line may be."""

_OLD_NONCE = re.compile(r"[0-9a-f]{32}")
"""The nonces of agents that know version 1 only. Those of later agents begin with NONCE."""

_NONCE = "2:"

LONGEST_REASON = 300
"""Most characters of a reason that an agent gave before it was authenticated."""


class AuthenticationFailed(ProtocolError):
    """The other side did not prove that it may command this agent. It has received the reason."""

    def __init__(self, workload: str, claim: str, reason: str) -> None:
        super().__init__(reason)
        self.workload, self.claim = workload, claim


class AgentDeclined(Exception):
    """The agent ended the session before it was authenticated. Anybody who receives the connection can send the reason."""


class Channel:
    """One end of a session, after each side has proved the token."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        workload: str,
        claim: str,
        *,
        sending: LineAuthentication | None = None,
        receiving: LineAuthentication | None = None,
        probe_key: bytes = b"",
    ) -> None:
        self.workload, self.claim, self.probe_key = workload, claim, probe_key
        """``probe_key`` authenticates the gate probes of the agent's pod; it is empty in version 1."""
        self._reader, self._writer = reader, writer
        self._sending, self._receiving = sending, receiving

    def write(self, message: Mapping[str, Any]) -> None:
        """Send a message. Raises ProtocolError if it is too long."""
        line = wire.encode(message)
        self._writer.write(self._sending.seal(line) if self._sending is not None else line)

    async def read(self) -> dict[str, Any]:
        """Return the next message.

        Raises EOFError, ProtocolError, and NotAuthentic if it was not sent by the other side, or not in this order.
        """
        if self._receiving is None:
            return wire.decode(await wire.read_line(self._reader, wire.MAX_LINE))
        line = await wire.read_line(self._reader, wire.MAX_LINE + LineAuthentication.OVERHEAD)
        return wire.decode(self._receiving.open(line))


async def accept(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, uid: str, token: Callable[[], bytes]
) -> Channel:
    """Begin a session as the agent of the pod with this UID. ``token`` returns the secret and may raise OSError.

    Raises AuthenticationFailed, EOFError and ProtocolError.
    """
    nonce = _NONCE + secrets.token_hex(16)
    writer.write(wire.encode({"nonce": nonce, "version": OLDEST_PROTOCOL, "versions": [OLDEST_PROTOCOL, PROTOCOL]}))
    answer = await _read_greeting(reader)
    workload, claim, other = (str(answer.get(name, "")) for name in ("workload", "claim", "nonce"))

    async def refuse(reason: str) -> AuthenticationFailed:
        writer.write(wire.encode({"error": reason}))
        await writer.drain()
        return AuthenticationFailed(workload, claim, reason)

    try:
        secret = token()
    except OSError as error:
        raise await refuse(f"the agent cannot read its token: {error.strerror}") from error
    if not secret:
        raise await refuse("the agent's token is empty")
    proof = str(answer.get("mac", ""))
    if answer.get("version") != PROTOCOL:
        if not session_keys.equal(session_keys.legacy_proof(secret, nonce, workload, claim), proof):
            raise await refuse("authentication failed: the monitor and the agent have different tokens")
        return Channel(reader, writer, workload, claim)
    keys = session_keys.derive(secret, uid=uid, agent_nonce=nonce, monitor_nonce=other, workload=workload, claim=claim)
    if not session_keys.equal(keys.monitor_proof, proof):
        raise await refuse(
            "authentication failed: the monitor and the agent have different tokens, or the monitor means another pod. The agent reads "
            "its Secret again for each session, and the monitor if it is refused, so different tokens last for about a minute"
        )
    writer.write(wire.encode({"mac": keys.agent_proof}))
    return _channel(reader, writer, workload, claim, keys, sending=keys.to_monitor, receiving=keys.to_agent)


async def connect(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    *,
    uid: str,
    token: bytes,
    workload: str,
    claim: str,
    oldest: int = PROTOCOL,
) -> Channel:
    """Begin a session as the monitor, with the agent of the pod with this UID. ``oldest`` is the protocol that its agent knows at least.

    In version 1, the first message is an error if the agent does not accept the session. Raises AgentDeclined, EOFError, NotAuthentic and
    ProtocolError.
    """
    greeting = await _read_greeting(reader)
    nonce, versions = greeting.get("nonce"), greeting.get("versions", [greeting.get("version")])
    if not isinstance(nonce, str) or not isinstance(versions, list):
        raise ProtocolError(f"not the greeting of an agent: {greeting!r:.200}")
    if PROTOCOL in versions:
        return await _connect(reader, writer, uid, token, workload, claim, nonce)
    if oldest >= PROTOCOL or OLDEST_PROTOCOL not in versions:
        raise ProtocolError(
            f"the agent greets with protocol version {greeting.get('version')!r:.20}, but its pod's spec names version {oldest}. If the "
            "agent's image is of another version of Understudy, replace the pod. Otherwise somebody else answers at its address"
        )
    if not _OLD_NONCE.fullmatch(nonce):
        raise NotAuthentic("somebody relays the greeting of another agent")
    if greeting.get("uid", uid) != uid:
        raise ProtocolError("the agent of another pod answers at this address")
    proof = session_keys.legacy_proof(token, nonce, workload, claim)
    writer.write(wire.encode({"workload": workload, "claim": claim, "mac": proof}))
    return Channel(reader, writer, workload, claim)


async def _connect(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    uid: str,
    token: bytes,
    workload: str,
    claim: str,
    nonce: str,
) -> Channel:
    own = secrets.token_hex(16)
    keys = session_keys.derive(token, uid=uid, agent_nonce=nonce, monitor_nonce=own, workload=workload, claim=claim)
    proof = keys.monitor_proof
    writer.write(wire.encode({"version": PROTOCOL, "nonce": own, "workload": workload, "claim": claim, "mac": proof}))
    answer = await _read_greeting(reader)
    if "error" in answer:
        raise AgentDeclined(str(answer["error"])[:LONGEST_REASON])
    if not session_keys.equal(keys.agent_proof, str(answer.get("mac", ""))):
        raise NotAuthentic(
            "who answers does not prove that it is the pod's agent: it does not know the token, or is another pod"
        )
    return _channel(reader, writer, workload, claim, keys, sending=keys.to_agent, receiving=keys.to_monitor)


def _channel(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    workload: str,
    claim: str,
    keys: SessionKeys,
    *,
    sending: bytes,
    receiving: bytes,
) -> Channel:
    return Channel(
        reader,
        writer,
        workload,
        claim,
        sending=LineAuthentication(sending),
        receiving=LineAuthentication(receiving),
        probe_key=keys.probes,
    )


async def _read_greeting(reader: asyncio.StreamReader) -> dict[str, Any]:
    return wire.decode(await wire.read_line(reader, wire.MAX_GREETING))
