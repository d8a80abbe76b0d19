"""The state of real managed nodes, by their transitions and by what they answer."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from tests.unit.ros.processes import Processes
from understudy.ros.actions.instance_calls import CallFailed, InstanceCaller
from understudy.ros.dds.host_ids import HOST
from understudy.ros.observe.lifecycle_states import LifecycleStates
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.graph_node import Endpoint
from understudy.trees.core.observations import TopicRecord

pytestmark = pytest.mark.ros

MANAGED = Path(__file__).with_name("managed.py")
NODE = "/managed"


@pytest.fixture
def managed(dds: None) -> Iterator[Callable[[], Any]]:
    """Starts managed nodes."""
    running: list[subprocess.Popen[str]] = []

    def start(kind: str = "") -> Any:
        process = subprocess.Popen([sys.executable, str(MANAGED), kind], stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert Processes.line(process, 30) == "ready"
        return process

    yield start
    for process in running:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes are asked more often."""
    monkeypatch.setattr("understudy.ros.observe.node_inquiries.PERIOD", 0.3)


def bring_to(state: str) -> None:
    async def bring() -> None:
        caller = InstanceCaller("bringer")
        try:
            await caller.bring_to(NODE, state, 30.0)
        finally:
            caller.close()

    asyncio.run(bring())


def test_a_node_that_leaves_its_state_fails_and_earlier_states_are_requested(watching, graph, managed, eventually):
    managed()
    judged = Judged(watching, {"lifecycle": {"node": NODE}})
    eventually(lambda: judged.now().reason == "node /managed is unconfigured, but active is required (not met yet)")
    bring_to("active")
    eventually(lambda: judged.now().state == "Healthy")
    (host,) = {end.gid[HOST] for end in graph.servers(f"{NODE}/get_state")}
    for late in (TopicWatch(graph), TopicWatch(graph, host)):
        try:
            other = Judged(late, {"lifecycle": {"node": NODE}})
            eventually(lambda other=other: other.now().state == "Healthy")
            assert not late.own(f"{NODE}/transition_event"), "it was told by an answer alone"
        finally:
            late.close()
    bring_to("inactive")
    eventually(lambda: judged.now().state == "Failed")
    assert " is deactivating, but " in judged.now().reason or " is inactive, but " in judged.now().reason
    bring_to("active")
    eventually(lambda: judged.now().state == "Healthy")
    assert watching.problems == []


def test_publishing_setting_parameters_and_other_nodes_have_no_influence(watching, managed, eventually):
    managed()
    bring_to("active")
    judged = Judged(watching, {"lifecycle": {"node": NODE}})
    eventually(lambda: judged.now().state == "Healthy")

    async def disturb() -> None:
        caller = InstanceCaller("other")
        try:
            await caller.set_parameters(NODE, {"speed": 2.0}, 30.0)
            await caller.call("/switch", "std_srvs/srv/SetBool", {"data": True}, 30.0)
        finally:
            caller.close()

    asyncio.run(disturb())
    transition = watching.lifecycle(NODE).received
    eventually(lambda: judged.now() and watching.lifecycle(NODE).received > transition + 1.0)
    assert judged.now().state == "Healthy"


def test_a_missing_node_is_reported(watching, eventually):
    judged = Judged(watching, {"lifecycle": {"node": NODE}}, grace=0.001)
    eventually(lambda: judged.now().state == "Failed" and " is not there, but " in judged.now().reason)


async def activate(states: LifecycleStates) -> None:
    """Have all nodes configured, and then activated, which one of them refuses; each request reaches all."""
    caller = InstanceCaller("bringer")

    async def change(transition: int) -> None:
        request = {"transition": {"id": transition}}
        with contextlib.suppress(CallFailed):  # of two answers to one request, the one that is waited for may be lost
            await caller.call(f"{NODE}/change_state", "lifecycle_msgs/srv/ChangeState", request, 3.0)

    try:
        async with asyncio.timeout(30):
            while states.of(NODE).state != "inactive":
                await change(1)
                for _ in range(50):
                    states.refresh()
                    await asyncio.sleep(0.02)
        await change(3)
    finally:
        caller.close()


@dataclass
class ReportedTransition:
    """A transition of the instance in control."""

    received: float
    label: str

    def message(self) -> Any:
        from lifecycle_msgs.msg import State, TransitionEvent

        return TransitionEvent(goal_state=State(label=self.label))


def test_answers_of_equally_named_nodes_in_several_pods_count_only_if_they_agree(graph, managed, eventually):
    managed()
    eventually(lambda: len(graph.servers(f"{NODE}/get_state")) == 1)
    (own,) = {end.gid[:12] for end in graph.servers(f"{NODE}/get_state")}
    managed("refusing")
    eventually(lambda: len(graph.servers(f"{NODE}/get_state")) == 2)
    record = TopicRecord(contents=1)
    states = LifecycleStates(graph, lambda gid: gid[:12] == own, lambda topic: record, alone=False)
    try:
        states.follow([NODE])
        eventually(lambda: states.refresh() or (states.of(NODE) and states.of(NODE).state == "unconfigured"))
        assert states.problems == [], "both say the same"
        asyncio.run(activate(states))
    finally:
        states.close()
    states = LifecycleStates(graph, lambda gid: gid[:12] == own, lambda topic: record, alone=False)
    try:
        states.follow([NODE])
        eventually(lambda: states.refresh() or states.problems)
        assert_golden("ros", states.problems, "/managed", "2 nodes", "active", "inactive")
        assert states.of(NODE).state is None
        record.contents.append(ReportedTransition(time.time(), "active"))
        states.refresh()
        assert (states.of(NODE).state, states.problems) == ("active", [])
        before = states.of(NODE).received
        eventually(lambda: states.refresh() or states.of(NODE).received > before + 1.0)
        assert (states.of(NODE).state, states.problems) == ("active", []), "what it told stands"
    finally:
        states.close()


def test_the_state_of_a_replacement_process_is_known_only_from_its_own_events(graph, managed, monkeypatch):
    """The servers are made up: DDS takes note of a killed process only after 20 s."""
    node = Endpoint("lifecycle_msgs::srv::dds_::GetState_Request_", b"", NODE)
    servers = [replace(node, gid=b"a" * 16)]
    monkeypatch.setattr(graph, "servers", lambda service: list(servers))
    for name in ("PERIOD", "RETRY"):
        monkeypatch.setattr(f"understudy.ros.observe.node_inquiries.{name}", 0.0)
    record = TopicRecord(contents=1)
    states = LifecycleStates(graph, lambda gid: True, lambda topic: record, alone=True)
    try:
        states.follow([NODE])
        record.contents.append(ReportedTransition(time.time(), "active"))
        states.refresh()
        states.refresh()
        assert states.of(NODE).state == "active"
        servers[:] = [replace(node, gid=b"b" * 16)]
        states.refresh()
        assert states.of(NODE) is None
        record.contents.append(ReportedTransition(time.time(), "inactive"))
        servers[:] = [replace(node, gid=b"c" * 16)]
        states.refresh()
        assert states.of(NODE).state == "inactive", "it was told by the new one"
        servers.clear()
        states.refresh()
        assert states.of(NODE).state == ""
    finally:
        states.close()
