"""Commands to agents: each carries the epoch of its decision, and none is sent that the API server does not confirm."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

import pytest

from tests.support.agents import PRIVATE_KEY, known_to_agent
from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.kept_state import KeptState
from understudy.api.protocol.secure_channel import accept
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import GateState, Instance, NotVerified
from understudy.kube.agent_client import AgentGone
from understudy.kube.client import SECRETS
from understudy.monitor.observe import agent_connections as module
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles

INSTANCE = Instance("w-1", "uid-1", ip="127.0.0.1", running=True, has_agent=True)
PROCEDURE = BringUp("recovery", {"sequence": []}, within=0.5, digest="d", restores_state=False)


class RecordingAgent:
    """Accepts every request, as an agent of the instance would."""

    def __init__(self) -> None:
        self.requests: list[dict[str, Any]] = []
        self.writers: list[asyncio.StreamWriter] = []

    async def session(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        with contextlib.suppress(ConnectionError, EOFError):
            channel = await accept(reader, writer, uid=INSTANCE.uid, secret=lambda: known_to_agent(b"token"))
            channel.write({"status": AgentStatus("Running", True, configured=True).to_wire()})
            while True:
                self.requests.append(request := await channel.read())
                channel.write({"id": request["id"], "ok": True})

    def epochs(self, op: str) -> list[int]:
        """The epochs of the requests of an operation."""
        return [request["gate"]["epoch"] for request in self.requests if request["op"] == op]


def listens_at(server: asyncio.Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the agent of INSTANCE be at this server."""
    port = server.sockets[0].getsockname()[1]
    monkeypatch.setattr(sys.modules[__name__], "INSTANCE", replace(INSTANCE, agent_port=port))


@pytest.fixture
async def agent(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[RecordingAgent]:
    made = RecordingAgent()
    server = await asyncio.start_server(made.session, "127.0.0.1", 0)
    listens_at(server, monkeypatch)
    yield made
    server.close()
    for writer in made.writers:
        writer.transport.abort()


@pytest.fixture
async def objects(policy: FailurePolicySpec) -> ClusterObjects:
    """A workload whose gate was switched six times."""
    made = ClusterObjects()
    made.put_workload()
    made.put_policy(policy)
    made.put_settings()
    made.put_gate(GateState(epoch=6, active="w-1", active_uid="uid-1"))
    data = {
        names.TOKEN: base64.b64encode(b"token").decode(),
        names.MONITOR_PRIVATE_KEY: base64.b64encode(PRIVATE_KEY).decode(),
    }
    await made.client.create(SECRETS, NAMESPACE, {"metadata": {"name": names.agent_secret("w")}, "data": data})
    return made


@pytest.fixture
def policy() -> FailurePolicySpec:
    tree = {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}
    return FailurePolicySpec.model_validate({"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart"}]})


@pytest.fixture
async def agents(agent: RecordingAgent, objects: ClusterObjects) -> AsyncIterator[AgentConnections]:
    roles = InstanceRoles(objects.view, objects.gate, CurrentRecovery())
    made = AgentConnections(
        objects.client, objects.view, "127.0.0.1", objects.crash_points, roles, objects.wakeups, objects.proof
    )
    made.follow([INSTANCE])
    async with asyncio.timeout(20):
        while not agent.epochs("configure"):
            await asyncio.sleep(0.01)
    yield made
    made.follow([])


async def run(agents: AgentConnections) -> None:
    await agents.run(INSTANCE, PROCEDURE, within=0.5, state=KeptState(), brought="")


async def test_a_command_carries_the_epoch_of_the_gate(agents: AgentConnections, agent: RecordingAgent) -> None:
    await run(agents)
    assert agent.epochs("procedure") == [6]


async def test_agents_receive_each_new_epoch(
    agents: AgentConnections, agent: RecordingAgent, objects: ClusterObjects
) -> None:
    objects.put_gate(GateState(epoch=7, active="w-2", active_uid="uid-2"))
    agents.follow([INSTANCE])
    async with asyncio.timeout(20):
        while agent.epochs("configure")[-1] != 7:
            await asyncio.sleep(0.01)


async def test_an_agent_is_configured_again_only_once_the_api_server_confirms_the_gate(
    agents: AgentConnections, agent: RecordingAgent, objects: ClusterObjects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A successor of a monitor that is cut off may have configured the agent by a newer policy, at the same epoch."""
    monkeypatch.setattr(module, "CONFIRMED_FOR", 0.0)
    objects.client.failing = lambda method, name: TimeoutError()
    before = len(agent.epochs("configure"))
    agent.writers[-1].transport.abort()
    async with asyncio.timeout(20):
        while len(agent.writers) < 2:
            await asyncio.sleep(0.01)
    for _ in range(20):
        agents.follow([INSTANCE])
        await asyncio.sleep(0.01)
    assert len(agent.epochs("configure")) == before
    objects.client.failing = lambda method, name: None
    async with asyncio.timeout(20):
        while len(agent.epochs("configure")) == before:
            agents.follow([INSTANCE])
            await asyncio.sleep(0.01)


async def test_nobody_is_commanded_while_the_api_server_does_not_answer(
    agents: AgentConnections, agent: RecordingAgent, objects: ClusterObjects, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CONFIRMED_FOR", 0.0)
    objects.client.failing = lambda method, name: TimeoutError()
    agents._configured.clear()
    commanding = asyncio.create_task(run(agents))
    starting, readying = asyncio.create_task(agents.start(INSTANCE)), asyncio.create_task(agents.ready(INSTANCE))
    configured = len(agent.epochs("configure"))
    await asyncio.sleep(2 * PROCEDURE.within)
    with pytest.raises(AgentGone, match="API server does not confirm"):
        await agents.renew_permit(INSTANCE, {"witnesses": [], "word": "Go"})
    await agents.renew_permit(INSTANCE, {"witnesses": ["10.0.0.1"]})
    assert [request["op"] for request in agent.requests if request["op"] not in ("configure", "probe")] == ["lease"]
    assert len(agent.epochs("configure")) == configured
    objects.client.failing = lambda method, name: None
    await asyncio.gather(commanding, starting)
    assert agent.epochs("procedure") == [6], "the outage is not charged to the procedure"
    assert agent.epochs("start") == [6]
    async with asyncio.timeout(20):
        while len(agent.epochs("configure")) == configured:
            await asyncio.sleep(0.01)
    readying.cancel()


async def test_nobody_is_commanded_by_a_monitor_that_another_one_has_replaced(
    agents: AgentConnections, agent: RecordingAgent, objects: ClusterObjects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The watch has not reported the commit of the other monitor yet."""
    monkeypatch.setattr(module, "CONFIRMED_FOR", 0.0)
    known = objects.view.gates.items[names.gate("w")]
    objects.put_gate(GateState(epoch=7, active="w-2", active_uid="uid-2"))
    objects.view.gates.items[names.gate("w")] = known
    with pytest.raises(NotVerified, match=r"switched meanwhile \(epoch 7\); the decision was of epoch 6"):
        await run(agents)
    objects.view.gates.items[names.gate("w")] = known
    with pytest.raises(NotVerified, match=r"switched meanwhile"):
        await agents.start(INSTANCE)
    assert not agent.epochs("procedure")
    assert not agent.epochs("start")


async def test_an_answer_of_a_moment_ago_is_enough(
    agents: AgentConnections, agent: RecordingAgent, objects: ClusterObjects, monkeypatch: pytest.MonkeyPatch
) -> None:
    await run(agents)
    reads = [name for method, name, _ in objects.client.requests if method == "GET"].count(names.gate("w"))
    await run(agents)
    assert reads == 1
    assert [name for method, name, _ in objects.client.requests if method == "GET"].count(names.gate("w")) == 1
    monkeypatch.setattr(module, "CONFIRMED_FOR", 0.0)
    await run(agents)
    assert [name for method, name, _ in objects.client.requests if method == "GET"].count(names.gate("w")) == 2
    assert agent.epochs("procedure") == [6, 6, 6]
