"""Requests to an agent, as a monitor makes them."""

from __future__ import annotations

from understudy.api.protocol.agent_messages import AgentStatus
from understudy.kube.agent_client import AgentLink


async def status_of(link: AgentLink) -> AgentStatus:
    """Ask an agent for its present status."""
    answer = await link.request("status", {})
    return AgentStatus.from_wire(answer["status"])
