"""Requests to an agent, as a monitor makes them, and an agent for its control channel."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from understudy.api.protocol.agent_messages import AgentStatus, GateEpoch
from understudy.kube.agent_client import AgentLink


async def status_of(link: AgentLink) -> AgentStatus:
    """Ask an agent for its present status."""
    answer = await link.request("status", {})
    return AgentStatus.from_wire(answer["status"])


class IdleAgent:
    """What a control channel asks an agent whose instance does nothing, except for its operations."""

    secret = b"secret"

    def __init__(self) -> None:
        self.version = 0
        self.epochs: list[GateEpoch] = []
        """Of the requests."""

    def greeting(self) -> Mapping[str, str]:
        return {"pod": "robot-1", "uid": "1"}

    def token(self) -> bytes:
        return self.secret

    def refuses(self, workload: str, claim: str) -> str | None:
        return None

    def outdated(self, epoch: GateEpoch) -> str | None:
        self.epochs.append(epoch)
        return None

    def status(self) -> AgentStatus:
        return AgentStatus()

    async def changed(self, version: int) -> None:
        await asyncio.Event().wait()
