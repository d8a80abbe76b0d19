"""What happens to an instance that was cut off, and who may prove that one is not."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import NAMESPACE, TWIST, ClusterObjects
from tests.unit.monitor.senses import GivenAgents, GivenGraph
from understudy.api import names
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import PODS as ALL_PODS
from understudy.kube.client import Object
from understudy.monitor.act.gate import permits as module
from understudy.monitor.act.gate.permits import Permits, Word, witnesses, word
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.ros.dds.host_ids import VENDOR, host_id
from understudy.ros.runtime.graph_node import Endpoint

ACTIVE, STANDBY = Instance("a", "uid-a", running=True), Instance("s", "uid-s", running=True)
BEFORE, AFTER = GateState(3, "a", "uid-a"), GateState(4, "s", "uid-s")
CLOSED = GateState(4)


def recovery(*failed: Instance, reflex: bool = False) -> Progress:
    pods = [PodIdentity(name=i.name, uid=i.uid) for i in failed]
    progress = Progress.begin("silent", last_healthy=0.0, detected=1.0, failed=pods)
    progress.taken_over = PodIdentity(name="s", uid="uid-s") if reflex else None
    return progress


@pytest.mark.parametrize(
    ("instance", "state", "replaced", "recovering", "expected"),
    [
        (ACTIVE, BEFORE, set(), None, "Go"),
        (STANDBY, BEFORE, set(), None, "Go"),
        (STANDBY, BEFORE, {"uid-s"}, None, "Stay"),
        (ACTIVE, BEFORE, {"uid-a"}, None, "Go"),
        (ACTIVE, BEFORE, set(), recovery(ACTIVE), "Go"),
        (ACTIVE, BEFORE, set(), recovery(ACTIVE, reflex=True), "Stay"),
        (STANDBY, BEFORE, set(), recovery(ACTIVE, reflex=True), "Go"),
        (STANDBY, BEFORE, set(), recovery(ACTIVE, STANDBY), "Stay"),
        (ACTIVE, CLOSED, set(), recovery(ACTIVE), "Stay"),
        (STANDBY, CLOSED, set(), recovery(ACTIVE), "Go"),
        (ACTIVE, AFTER, {"uid-a"}, None, "Stay"),
        (STANDBY, AFTER, {"uid-a"}, None, "Go"),
        (ACTIVE, AFTER, set(), recovery(ACTIVE, reflex=True), "Stay"),
    ],
)
def test_only_active_and_standby_instances_may_continue(
    instance: Instance, state: GateState, replaced: set[str], recovering: Progress | None, expected: Word
) -> None:
    assert word(instance, state, replaced, recovering) == expected
    ending = Instance(instance.name, instance.uid, running=True, terminating=True)
    assert word(ending, state, replaced, recovering) == "Stay"


def pod(name: str, ip: str, node: str, *, phase: str = "Running", host: bool = False, **labels: str) -> Object:
    return {
        "metadata": {
            "name": name,
            "uid": f"uid-{name}",
            "labels": {f"understudy.dev/{k}": v for k, v in labels.items()},
        },
        "spec": {"nodeName": node, **({"hostNetwork": True} if host else {})},
        "status": {"phase": phase, "podIP": ip},
    }


PODS = [
    pod("a", "10.1.1.1", "node1", workload="w"),
    pod("s", "10.1.2.1", "node2", workload="w"),
    pod("robot", "10.1.1.2", "node1"),
    pod("monitor", "10.1.2.2", "node2", monitored="w"),
    pod("near", "10.1.1.3", "node1"),
    pod("far-1", "10.1.2.3", "node2"),
    pod("far-2", "10.1.2.4", "node2"),
    pod("far-3", "10.1.2.5", "node2"),
    pod("further", "10.1.3.1", "node3"),
    pod("held", "10.1.3.2", "node3", held="true"),
    pod("done", "10.1.3.3", "node3", phase="Succeeded"),
    pod("daemon", "192.168.0.3", "node3", host=True),
]


def readers(*ips: str) -> set[bytes]:
    return {VENDOR + host_id(ip) for ip in ips}


def test_labels_are_named_after_the_constants() -> None:
    assert {names.WORKLOAD, names.HELD, names.MONITORED} == {
        f"understudy.dev/{label}" for label in ("workload", "held", "monitored")
    }


def test_robots_are_witnesses_anywhere_and_other_pods_only_on_other_nodes() -> None:
    reachable = readers("10.1.1.2", "10.1.2.2", "10.1.1.1")
    found = witnesses(ACTIVE, PODS, workload="w", readers=reachable, robots=["203.0.113.7/32", "198.51.100.0/24"])
    assert found[:2] == ["203.0.113.7", "10.1.1.2"]
    assert set(found[2:4]) == {"10.1.2.3", "10.1.3.1"}, "of as many nodes as possible"
    assert len(found) == 5
    assert "10.1.1.3" not in found, "it would answer although the node is cut off"


def test_a_standby_on_another_node_has_other_witnesses() -> None:
    found = witnesses(STANDBY, PODS, workload="w", readers=readers("10.1.1.2"), robots=[])
    assert found[0] == "10.1.1.2"
    assert set(found[1:]) >= {"10.1.1.3", "10.1.3.1"}
    assert not {"10.1.1.1", "10.1.3.2", "10.1.3.3", "192.168.0.3", "10.1.2.3"} & set(found)


def test_only_robots_are_witnesses_of_an_instance_on_an_unknown_node() -> None:
    stranger = Instance("x", "uid-x")
    assert witnesses(stranger, PODS, workload="w", readers=readers("10.1.1.2"), robots=[]) == ["10.1.1.2"]


class Agents(GivenAgents):
    """The agents' ends as the monitor sees them; one of them may not answer."""

    def __init__(self, objects: ClusterObjects, roles: InstanceRoles, deaf: str) -> None:
        super().__init__(objects, roles)
        self.deaf = deaf
        self.sessions: dict[str, int] = {}
        self.permits: list[tuple[str, Mapping[str, Any]]] = []

    def session(self, instance: Instance) -> tuple[int, int]:
        return (0, self.sessions.get(instance.uid, 1))

    async def renew_permit(self, instance: Instance, body: Mapping[str, Any]) -> None:
        if instance.uid == self.deaf:
            await asyncio.sleep(3600)
        self.permits.append((instance.uid, body))

    def words(self, uid: str) -> list[str]:
        return [body["word"] for to, body in self.permits if to == uid and "word" in body]

    def last(self, uid: str) -> Mapping[str, Any]:
        return next(body for to, body in reversed(self.permits) if to == uid)


class Away(MemoryClient):
    """An API server that does not answer who lists."""

    async def list(self, *_: Any, **__: Any) -> Object:
        await asyncio.sleep(3600)
        raise AssertionError("nobody waits for it")


class World:
    """The permits of one workload, and what they depend on."""

    def __init__(
        self,
        *statuses: tuple[str, AgentStatus],
        deaf: str = "",
        client: MemoryClient | None = None,
        reflex: bool = True,
    ) -> None:
        self.objects = ClusterObjects(client=client)
        self.current, self.wakeups = CurrentRecovery(), self.objects.wakeups
        self.agents = Agents(self.objects, InstanceRoles(self.objects.view, self.objects.gate, self.current), deaf)
        self.agents.statuses |= dict(statuses)
        self.objects.put_workload(gate={"reflex": {"deadline": "100ms"}} if reflex else {})
        self.objects.put_pods(ACTIVE, STANDBY)
        for item in PODS:
            self.objects.client.store(ALL_PODS, NAMESPACE, item)
        self.commit(BEFORE)
        graph = GivenGraph()
        graph.readers["/cmd_vel"] = [Endpoint(TWIST, VENDOR + host_id("10.1.1.2") + bytes(12), "/base")]
        notices = self.objects.notices
        self.permits = Permits(self.objects.cluster, self.agents, graph, self.current, self.wakeups, notices)

    def commit(self, state: GateState) -> None:
        """Have the gate in a state."""
        self.objects.put_gate(state)

    async def look(self) -> None:
        """Have the permits be looked at again."""
        self.wakeups.permits.set()
        await asyncio.sleep(0.005)

    @property
    def events(self) -> list[str]:
        """The text of each Event."""
        return [f"{reason}: {message}" for _, reason, message in self.objects.notices.events]


async def eventually(check: Callable[[], object]) -> None:
    async with asyncio.timeout(25):
        while not check():
            await asyncio.sleep(0.01)


def running() -> AgentStatus:
    return AgentStatus("Running", True)


def cut_off() -> AgentStatus:
    return AgentStatus("Running", False, "held", cut_off=1700000000.0)


async def test_every_agent_receives_its_witnesses_in_each_session() -> None:
    world = World(("uid-a", running()), ("uid-s", running()))
    agents = world.agents
    task = asyncio.create_task(world.permits.run())
    await eventually(
        lambda: {uid for uid, body in agents.permits if "10.1.1.2" in body["witnesses"]} == {"uid-a", "uid-s"}
    )
    assert not agents.words("uid-a"), "who isn't held needs no word"
    before = len(agents.permits)
    agents.sessions["uid-a"] = 2
    world.wakeups.permits.set()
    await eventually(lambda: len(agents.permits) > before)
    assert agents.permits[-1][0] == "uid-a"
    task.cancel()


async def test_neither_an_unavailable_api_server_nor_another_agent_delays_a_permit() -> None:
    world = World(("uid-a", running()), ("uid-s", running()), deaf="uid-a", client=Away())
    agents = world.agents
    task = asyncio.create_task(world.permits.run())
    await eventually(lambda: agents.permits)
    agents.statuses["uid-s"] = cut_off()
    world.wakeups.permits.set()
    await eventually(lambda: agents.words("uid-s") == ["Go"])
    await eventually(lambda: len(agents.words("uid-s")) > 1)  # again, until it is followed
    agents.statuses["uid-s"] = running()
    assert (
        len(
            [
                event
                for event in world.events
                if "s froze the application at 22:13:20 UTC" in event and "it runs again" in event
            ]
        )
        == 1
    )
    task.cancel()


async def test_an_inactive_instance_may_continue_after_its_node_could_learn_of_the_gate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "CATCH_UP", 0.3)
    world = World(("uid-a", running()), ("uid-s", running()))
    agents = world.agents
    task = asyncio.create_task(world.permits.run())
    await eventually(lambda: agents.permits)
    agents.statuses |= {"uid-a": cut_off(), "uid-s": cut_off()}
    started_at = time.monotonic()
    world.wakeups.permits.set()
    await eventually(lambda: agents.words("uid-a"))
    assert agents.words("uid-s") == []
    assert time.monotonic() - started_at < 0.3
    await eventually(lambda: agents.words("uid-s"))
    assert time.monotonic() - started_at >= 0.3

    agents.statuses["uid-s"] = running()
    world.wakeups.permits.set()
    await eventually(lambda: "word" not in agents.last("uid-s"))
    agents.statuses["uid-s"] = cut_off()
    sent = len(agents.words("uid-s"))
    world.wakeups.permits.set()
    await asyncio.sleep(0.15)
    assert len(agents.words("uid-s")) == sent, "the wait begins again with each cut-off"
    task.cancel()


async def test_a_replaced_instance_must_stay_held_as_long_as_it_exists() -> None:
    world = World(("uid-a", cut_off()), ("uid-s", running()))
    agents = world.agents
    world.current.progress = recovery(ACTIVE, reflex=True)
    task = asyncio.create_task(world.permits.run())
    await eventually(lambda: agents.words("uid-a"))
    committed, world.current.progress = world.current.progress, None
    for named in (committed, recovery(Instance("p", "uid-p"))):  # by the gate, which names the last one only
        world.commit(replace(AFTER, recovery=named))
        count = len(agents.words("uid-a"))
        await eventually(lambda count=count: len(agents.words("uid-a")) > count + 1)  # type: ignore[misc]
    assert set(agents.words("uid-a")) == {"Stay"}
    task.cancel()


async def test_an_instance_whose_recovery_stopped_before_its_commit_may_continue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As where somebody deletes the gate: whoever is put in control then, it stands by, and was held for good."""
    monkeypatch.setattr(module, "CATCH_UP", 0.1)
    world = World(("uid-a", cut_off()), ("uid-s", running()))
    agents = world.agents
    world.current.progress = recovery(ACTIVE, reflex=True)
    task = asyncio.create_task(world.permits.run())
    await eventually(lambda: agents.words("uid-a"))
    assert set(agents.words("uid-a")) == {"Stay"}
    world.current.progress = None
    world.commit(AFTER)
    await eventually(lambda: agents.words("uid-a")[-1] == "Go")
    task.cancel()


async def test_without_a_reflex_no_agent_receives_anything() -> None:
    world = World(("uid-a", running()), reflex=False)
    task = asyncio.create_task(world.permits.run())
    await asyncio.sleep(0.1)
    assert not world.agents.permits
    task.cancel()


async def test_only_the_oldest_of_many_replaced_pods_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "REMEMBERED", 5)
    monkeypatch.setattr(module, "CATCH_UP", 0.1)
    replaced = [Instance(f"p-{number}", f"uid-{number}", running=True) for number in range(7)]
    world = World()
    task = asyncio.create_task(world.permits.run())
    for one in replaced:
        world.commit(replace(AFTER, recovery=recovery(one)))
        await world.look()
    world.objects.put_pods(STANDBY, *replaced)
    world.agents.statuses |= {one.uid: cut_off() for one in replaced}
    await world.look()
    await eventually(lambda: all(world.agents.words(one.uid) for one in replaced))
    assert [world.agents.words(one.uid)[-1] for one in replaced] == ["Go"] * 2 + ["Stay"] * 5
    task.cancel()


async def test_an_isolated_instance_is_reported_once_as_long_as_it_exists() -> None:
    world = World(("uid-a", cut_off()))
    task = asyncio.create_task(world.permits.run())
    for present, count in (((ACTIVE,), 1), ((ACTIVE,), 1), ((), 1), ((ACTIVE,), 2)):
        world.objects.put_pods(STANDBY, *present)
        await world.look()
        assert len(world.events) == count
    task.cancel()
