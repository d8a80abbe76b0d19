"""The monitor hands kept state to a real agent, which gives it to real nodes; large and lost ones in bounded time."""

from __future__ import annotations

import asyncio
import os
import re
import time
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.support.agents import known_to_monitor
from tests.unit.agent.conftest import Pod
from tests.unit.agent.localization import OUTPUTS, TREE, WITHIN, localize
from tests.unit.agent.poses import pose
from tests.unit.monitor.cluster_objects import ClusterObjects
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.api.protocol.kept_state import LARGEST, KeptSample, KeptState, NotRestored, ParameterValues
from understudy.failover.interfaces import GateState, Instance
from understudy.kube.agent_client import AgentGone, AgentLink
from understudy.monitor.observe.agent_connections import AgentConnections

pytestmark = pytest.mark.ros

CONFIGURE = {"set_lifecycle": {"node": "/localizer", "state": "inactive"}}
EPOCH = GateEpoch("uid-w", 1)
INSTANCE = Instance("robot-1", "uid-1", ip="127.0.0.1", running=True)


def sidecars(link: AgentLink | None, tmp_path: Any) -> AgentConnections:
    """The monitor's side, with one agent."""
    roles: Any = None
    objects = ClusterObjects(tmp_path)
    objects.put_settings()
    objects.put_gate(GateState(epoch=EPOCH.number, active=INSTANCE.name, active_uid=INSTANCE.uid))
    made = AgentConnections(
        objects.client, objects.view, "127.0.0.1", objects.crash_points, roles, objects.wakeups, objects.proof
    )
    if link is not None:
        made._links[INSTANCE.uid] = link
    return made


async def persistently(ask: Callable[[], Awaitable[Any]]) -> Any:
    """Ask until it is answered: an agent that is only just joining ROS may be silent for seconds on a busy machine."""
    end = time.monotonic() + 3 * WITHIN
    while True:
        try:
            return await ask()
        except AgentGone:
            assert time.monotonic() < end
            await asyncio.sleep(0.1)


async def connected(pod: Pod, links: list[AgentLink]) -> AgentLink:
    links.append(link := pod.link(epoch=lambda: EPOCH))
    await link.wait_connected(WITHIN)
    await persistently(lambda: link.configure(TREE, OUTPUTS, 20.0))
    return link


async def test_state_is_restored_and_inspected(robot: Pod, links: list[AgentLink], tmp_path: Any) -> None:
    localize(robot)
    link = await connected(robot, links)
    monitor = sidecars(link, tmp_path)
    await persistently(lambda: link.procedure(CONFIGURE, WITHIN, name="initialization"))
    state = KeptState((pose(confirm="/amcl_pose"),), (ParameterValues("/localizer", {"speed": 0.75}, 1.0),))

    report = await monitor.restore(INSTANCE, state, 2 * WITHIN)

    assert report.not_restored == ()
    assert sorted(entry.name for entry in report.restored) == ["/amcl_pose", "/localizer (parameters)"]
    asked = {"parameters": [{"node": "/localizer", "names": ["speed"]}], "lifecycle": ["/localizer"]}
    found = await persistently(lambda: monitor.inspect(INSTANCE, asked, WITHIN))
    assert found["parameters"] == {"/localizer": {"speed": 0.75}}
    assert found["lifecycle"] == {"/localizer": "inactive"}


async def test_a_recovery_tree_decides_when_state_is_restored(
    robot: Pod, links: list[AgentLink], tmp_path: Any
) -> None:
    localize(robot)
    link = await connected(robot, links)
    tree = {
        "sequence": [
            {"set_lifecycle": {"node": "/localizer", "state": "inactive"}},
            {"restore_state": {"only": ["/amcl_pose"]}},
            {"set_lifecycle": {"node": "/localizer", "state": "active"}},
        ]
    }
    state = KeptState((pose(confirm="/amcl_pose"),), (ParameterValues("/localizer", {"speed": 0.75}, 1.0),))
    wire = state.to_wire()
    answer = await persistently(lambda: link.procedure(tree, WITHIN, name="recovery", state=wire))
    assert [entry["name"] for entry in answer["restored"]] == ["/amcl_pose"]
    asked = {"parameters": [{"node": "/localizer", "names": ["speed"]}], "lifecycle": ["/localizer"]}
    found = await persistently(lambda: sidecars(link, tmp_path).inspect(INSTANCE, asked, WITHIN))
    assert found["parameters"] == {"/localizer": {"speed": 0.25}}
    assert found["lifecycle"] == {"/localizer": "active"}


async def test_large_state_is_sent_in_several_requests(robot: Pod, links: list[AgentLink], tmp_path: Any) -> None:
    monitor = sidecars(await connected(robot, links), tmp_path)
    big = LARGEST // 2 + 1
    charts = tuple(
        KeptSample(f"/map{i}", "std_msgs/msg/String", 1.0, os.urandom(big), to=f"/nobody{i}") for i in range(2)
    )
    old = NotRestored("/plan", "too old", failed=False)
    report = await monitor.restore(INSTANCE, KeptState(charts, left_out=(old,)), 6.0)
    assert old in report.not_restored
    assert {entry.name for entry in report.failed} == {"/map0", "/map1"}
    assert "nobody subscribes to /nobody0" in report.problem
    assert "nobody subscribes to /nobody1" in report.problem


async def test_a_missing_agent_is_reported_in_bounded_time(tmp_path: Any) -> None:
    link = AgentLink("127.0.0.1", 1, known_to_monitor(b"token"), "robot", "", uid="uid-1")
    monitor = sidecars(link, tmp_path)
    started_at = time.monotonic()
    report = await monitor.restore(INSTANCE, KeptState((pose(),)), 0.5)
    assert time.monotonic() - started_at < 10
    assert report.problem.startswith("/amcl_pose: ")
    assert re.search(r"within 0\.[0-5]\d* s$", report.problem)
    with pytest.raises(AgentGone):
        await monitor.inspect(INSTANCE, {}, 0.5)
    await link.close()


async def test_a_request_is_repeated_if_the_agent_disconnects(
    robot: Pod, links: list[AgentLink], tmp_path: Any
) -> None:
    link = await connected(robot, links)
    monitor = sidecars(link, tmp_path)
    giving = asyncio.create_task(monitor.restore(INSTANCE, KeptState((pose(),)), 4 * WITHIN))
    await asyncio.sleep(0.5)
    assert robot.agent is not None
    robot.kill(robot.agent)
    robot.start_agent()
    localize(robot)
    other = await connected(robot, links)
    await persistently(lambda: other.procedure(CONFIGURE, WITHIN, name="initialization"))
    report = await giving
    assert [entry.name for entry in report.restored] == ["/amcl_pose"], report
