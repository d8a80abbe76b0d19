"""Requests to an agent, as a monitor makes them, and an agent for its control channel."""

from __future__ import annotations

import asyncio
import secrets

from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import monitor_key
from understudy.api.protocol.agent_messages import AgentStatus, GateEpoch
from understudy.api.protocol.secure_channel import AgentSecret, MonitorSecret
from understudy.api.protocol.session_keys import legacy_proof
from understudy.kube.agent_client import AgentLink

PRIVATE_KEY, PUBLIC_KEY = monitor_key.pair("the monitor of the tests")


def known_to_agent(token: bytes) -> AgentSecret:
    """What an agent with a token knows."""
    return AgentSecret(token, PUBLIC_KEY)


def known_to_monitor(token: bytes) -> MonitorSecret:
    """What the monitor with a token knows."""
    return MonitorSecret(token, PRIVATE_KEY)


async def status_of(link: AgentLink) -> AgentStatus:
    """Ask an agent for its present status."""
    answer = await link.request("status", {})
    return AgentStatus.from_wire(answer["status"])


class IdleAgent:
    """What a control channel asks an agent whose instance does nothing, except for its operations."""

    token, uid = b"secret", "1"
    proof = known_to_monitor(token)
    """What a monitor needs to be accepted."""

    def __init__(self) -> None:
        self.version = 0
        self.epochs: list[GateEpoch] = []
        """Of the requests."""

    def secret(self) -> AgentSecret:
        return known_to_agent(self.token)

    def refuses(self, workload: str, claim: str) -> str | None:
        return None

    def outdated(self, epoch: GateEpoch) -> str | None:
        self.epochs.append(epoch)
        return None

    def status(self) -> AgentStatus:
        return AgentStatus()

    async def changed(self, version: int) -> None:
        await asyncio.Event().wait()


async def old_session(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, uid: str, token: bytes) -> None:
    """A session of an agent of version 0.2.0, which knows version 1 of the protocol only and accepts every request."""
    nonce = secrets.token_hex(16)
    writer.write(wire.encode({"nonce": nonce, "pod": "robot-1", "uid": uid, "version": 1}))
    answer = wire.decode(await reader.readline())
    if answer["mac"] != legacy_proof(token, nonce, answer["workload"], answer["claim"]):
        writer.write(wire.encode({"error": "authentication failed"}))
        writer.close()
        return
    writer.write(wire.encode({"status": AgentStatus("Running", True).to_wire(), "number": 1}))
    while line := await reader.readline():
        writer.write(wire.encode({"id": wire.decode(line)["id"], "ok": True}))
