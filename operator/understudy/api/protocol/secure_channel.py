"""The beginning of a session between a monitor and an agent, and the authenticated lines after it. Both ends use this module.

The agent speaks first: ``{"nonce", "key", "version": 1, "versions": [1, 2, 3]}``. The monitor answers ``{"version": 3, "nonce",
"workload", "claim", "mac"}``. If the MAC is right, the agent answers ``{"mac"}``, and the monitor believes nothing before it has verified
that. From then on each line is authenticated (session_keys.py). The agent does not send its pod's UID: the monitor knows it from the API
server, and the MACs include it. So what one agent sends is of no use at another one.

Version 2 has no keys, so whoever knows the token passes for the monitor. An agent speaks it only as long as its Secret has no key of the
monitor. The operator writes one as soon as the monitor reports version 3, and the agent reads it once the kubelet has copied it. The
monitor accepts version 2, since who answers proves the token in both versions, and nothing more.

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
from dataclasses import dataclass, field
from typing import Any

# monitor_key imports it late, for the command. A process with sessions imports it at its start, and not while it watches a robot.
import cryptography.hazmat.primitives.asymmetric.x25519  # noqa: F401

from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import monitor_key, session_keys
from understudy.api.protocol.agent_messages import KEYED_PROTOCOL, OLDEST_PROTOCOL, PROTOCOL, ProtocolError
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


@dataclass(frozen=True)
class AgentSecret:
    """What an agent knows of its monitor."""

    token: bytes = field(repr=False)
    monitor_key: bytes = b""
    """The public key of the monitor; empty if the Secret has none."""


@dataclass(frozen=True)
class MonitorSecret:
    """What a monitor proves itself with to agents."""

    token: bytes = field(repr=False)
    key: bytes = field(default=b"", repr=False)
    """Its private key; empty if the Secret has none."""


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
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, uid: str, secret: Callable[[], AgentSecret]
) -> Channel:
    """Begin a session as the agent of the pod with this UID. ``secret`` may raise OSError.

    Raises AuthenticationFailed, EOFError and ProtocolError.
    """
    nonce = _NONCE + secrets.token_hex(16)
    own: monitor_key.AgentSide | None = None
    known, problem = AgentSecret(b""), ""
    try:
        known = secret()
        own = monitor_key.AgentSide(known.monitor_key) if known.monitor_key else None
    except OSError as error:
        problem = f"the agent cannot read its token: {error.strerror}"
    except ValueError:
        problem = (
            "the key of the monitor in the Secret is invalid: delete the Secret, and the operator creates another one"
        )
    greeting: dict[str, Any] = {
        "nonce": nonce,
        "version": OLDEST_PROTOCOL,
        "versions": [OLDEST_PROTOCOL, PROTOCOL],
    }
    if own is not None:
        greeting |= {"versions": [*greeting["versions"], KEYED_PROTOCOL], "key": own.public.hex()}
    writer.write(wire.encode(greeting))
    answer = await _read_greeting(reader)
    workload, claim, other = (str(answer.get(name, "")) for name in ("workload", "claim", "nonce"))

    async def refuse(reason: str) -> AuthenticationFailed:
        writer.write(wire.encode({"error": reason}))
        await writer.drain()
        return AuthenticationFailed(workload, claim, reason)

    if problem or not known.token:
        raise await refuse(problem or "the agent's token is empty")
    proof, version = str(answer.get("mac", "")), answer.get("version", OLDEST_PROTOCOL)
    if own is not None and version != KEYED_PROTOCOL:
        raise await refuse(
            "the monitor does not prove that it has its key: it is older than version 0.3, or is no monitor. After a rollback, see "
            "docs/how-to/production.md"
        )
    if version not in (PROTOCOL, KEYED_PROTOCOL):
        if not session_keys.equal(session_keys.legacy_proof(known.token, nonce, workload, claim), proof):
            raise await refuse("authentication failed: the monitor and the agent have different tokens")
        return Channel(reader, writer, workload, claim)
    keys = session_keys.derive(
        known.token,
        uid=uid,
        agent_nonce=nonce,
        monitor_nonce=other,
        workload=workload,
        claim=claim,
        shared=own.shared if own is not None else b"",
    )
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
    secret: MonitorSecret,
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
    if KEYED_PROTOCOL in versions:
        if not secret.key:
            raise AgentDeclined(
                "the agent knows a key of the monitor, and the monitor does not: it reads its Secret again"
            )
        try:
            shared = monitor_key.shared(secret.key, bytes.fromhex(str(greeting.get("key"))))
        except ValueError as error:
            raise ProtocolError(f"the key of the agent is invalid: {error}") from error
        return await _connect(reader, writer, uid, secret.token, workload, claim, nonce, shared)
    if PROTOCOL in versions:
        return await _connect(reader, writer, uid, secret.token, workload, claim, nonce)
    if oldest >= PROTOCOL or OLDEST_PROTOCOL not in versions:
        raise ProtocolError(
            f"the agent greets with protocol version {greeting.get('version')!r:.20}, but its pod's spec names version {oldest}. If the "
            "agent's image is of another version of Understudy, replace the pod. Otherwise somebody else answers at its address"
        )
    if not _OLD_NONCE.fullmatch(nonce):
        raise NotAuthentic("somebody relays the greeting of another agent")
    if greeting.get("uid", uid) != uid:
        raise ProtocolError("the agent of another pod answers at this address")
    proof = session_keys.legacy_proof(secret.token, nonce, workload, claim)
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
    shared: bytes = b"",
) -> Channel:
    own, version = secrets.token_hex(16), KEYED_PROTOCOL if shared else PROTOCOL
    keys = session_keys.derive(
        token, uid=uid, agent_nonce=nonce, monitor_nonce=own, workload=workload, claim=claim, shared=shared
    )
    proof = keys.monitor_proof
    writer.write(wire.encode({"version": version, "nonce": own, "workload": workload, "claim": claim, "mac": proof}))
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
