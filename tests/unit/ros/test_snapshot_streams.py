"""Snapshots are read by other processes, as py_trees_ros's watcher and its viewers read them."""

from __future__ import annotations

import asyncio
import json
import math
from typing import Any

import pytest

pytest.importorskip("rclpy")

from understudy.ros.actions import snapshot_streams
from understudy.ros.actions.snapshot_streams import LATCHED, LEAST, MOST, Streams
from understudy.ros.runtime.interface_types import TypeNotInstalled, interface_class
from understudy.trees.core.snapshot_behaviours import Behaviour, behaviours

pytestmark = pytest.mark.ros

SPACE = "/understudy/robot_1"
HEALTHY: dict[str, Any] = {
    "name": "parallel",
    "kind": "parallel",
    "state": "Healthy",
    "reason": "",
    "children": [
        {"name": "scan", "kind": "topic", "state": "Healthy", "reason": "", "topic": "/scan"},
        {"name": "cmd_vel", "kind": "topic", "state": "Healthy", "reason": "", "topic": "/cmd_vel"},
    ],
}


def listed(reason: str = "") -> list[Behaviour]:
    """The tree, with a failed leaf where there is a reason."""
    tree = json.loads(json.dumps(HEALTHY))
    if reason:
        tree["state"] = tree["children"][1]["state"] = "Failed"
        tree["children"][1]["reason"] = reason
    return behaviours(tree, "robot-1")


class Stage:
    """Streams, and a tree that is shown on them."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.streams = Streams(graph, SPACE)
        self.listed = listed()
        self.published = 0

    async def look(self) -> None:
        await self.streams.serve()
        if self.streams.read():
            self.published += self.streams.show(self.listed)
        await asyncio.sleep(0.02)

    async def call(self, name: str, **parameters: Any) -> Any:
        """The answer to a request of a tool, to open or to close a stream."""
        type_ = interface_class(f"py_trees_ros_interfaces/srv/{name.title()}SnapshotStream")
        request = type_.Request(topic_name=parameters.pop("topic"))
        for parameter, value in parameters.items():
            setattr(request.parameters, parameter, value)
        client = self.graph.node.create_client(type_, f"{SPACE}/snapshot_streams/{name}")
        try:
            await self.until(client.service_is_ready)
            with client.handle:
                client.handle.send_request(request)
            answers: list[Any] = []

            def answered() -> bool:
                with client.handle:
                    info, answer = client.handle.take_response(type_.Response)
                answers.append(answer)
                return info is not None

            await self.until(answered)
            return answers[-1]
        finally:
            self.graph.node.destroy_client(client)

    async def open(self, topic: str, period: float = math.inf) -> str:
        opened: str = (await self.call("open", topic=topic, snapshot_period=period)).topic_name
        return opened

    async def line(self, processes: Any, node: Any) -> Any:
        """What a process says next, while streams are looked at."""
        reading = asyncio.create_task(asyncio.to_thread(processes.line, node, 25))
        while not reading.done():
            await self.look()
        return json.loads(reading.result())

    async def until(self, holds: Any) -> None:
        async with asyncio.timeout(25):
            while not holds():
                await self.look()


@pytest.fixture
def stage(graph: Any) -> Any:
    made = Stage(graph)
    yield made
    made.streams.close()


async def test_a_watcher_of_the_topic_receives_each_change(stage: Stage, processes: Any) -> None:
    await stage.look()
    assert stage.published == 0, "nobody reads it"
    watcher = processes.node("draw", f"{SPACE}/snapshots", script="viewing.py")
    first = await stage.line(processes, watcher)
    assert first["changed"]
    assert (first["classes"], first["levels"]) == (["understudy.parallel", "understudy.topic", "understudy.topic"], [4])
    assert [line.split()[1:2] for line in first["drawn"][1:]] == [["scan"], ["cmd_vel"]]
    async with asyncio.timeout(20):
        while stage.streams.show(stage.listed):
            await asyncio.sleep(LEAST)  # a reader may have come in two steps
    await asyncio.sleep(3 * LEAST)
    assert stage.streams.read()
    assert stage.streams.show(stage.listed) == 0, "nothing has changed"
    stage.listed = listed("no /cmd_vel for 500 ms")
    second = await stage.line(processes, watcher)
    assert second["changed"]
    assert second["count"] > first["count"]
    assert second["drawn"][2].endswith("-- no /cmd_vel for 500 ms")


async def test_a_late_subscriber_receives_the_present_state(stage: Stage, processes: Any) -> None:
    processes.node("draw", f"{SPACE}/snapshots", script="viewing.py")
    await stage.until(lambda: stage.published)
    stage.listed = listed("no /cmd_vel for 500 ms")
    late = processes.node("draw", f"{SPACE}/snapshots", script="viewing.py")
    for _ in range(3):  # what it is given at once may be from before the change
        if "no /cmd_vel" in (await stage.line(processes, late))["drawn"][2]:
            return
    pytest.fail("it wasn't told of the change")


async def test_a_viewer_opens_and_closes_its_own_stream(stage: Stage, processes: Any, graph: Any) -> None:
    viewer = processes.node("open", SPACE, "0.2", script="viewing.py")
    topic = await stage.line(processes, viewer)
    assert topic == f"{SPACE}/snapshot_streams/_snapshots_0"
    lines = [await stage.line(processes, viewer) for _ in range(4)]
    assert any(not snapshot["changed"] for snapshot in lines), "it comes though nothing has changed"
    assert lines[-1]["interval"] >= LEAST - 0.01

    async def answer(line: str) -> Any:
        viewer.stdin.write(f"{line}\n")
        viewer.stdin.flush()
        while (found := await stage.line(processes, viewer)).get("drawn"):
            """Snapshots that were on their way."""
        return found

    assert await answer("inf") == {"set": True}
    assert stage.streams.periods[topic] == math.inf
    assert await answer("close") == {"closed": True}
    assert list(stage.streams.periods) == [f"{SPACE}/snapshots"]
    assert await answer("close") == {"closed": False}
    assert graph.publishers(f"{SPACE}/snapshots")
    assert not graph.publishers(topic)


async def test_a_client_cannot_choose_the_topic_or_exceed_the_limits(stage: Stage) -> None:
    assert await stage.open("/cmd_vel") == f"{SPACE}/snapshot_streams/_snapshots_0"
    assert await stage.open("~/a/../b") == f"{SPACE}/snapshot_streams/_snapshots_1"
    assert await stage.open("mine") == await stage.open("mine") == f"{SPACE}/snapshot_streams/mine"
    assert await stage.open("fast", 0.0) == f"{SPACE}/snapshot_streams/fast"
    assert stage.streams.periods[f"{SPACE}/snapshot_streams/fast"] == LEAST
    assert await stage.open("odd", math.nan) == f"{SPACE}/snapshot_streams/odd"
    assert stage.streams.periods[f"{SPACE}/snapshot_streams/odd"] == math.inf
    for number in range(MOST):
        await stage.open(f"more{number}")
    assert len(stage.streams.periods) == MOST
    assert await stage.open("one_more") == f"{SPACE}/snapshots"


async def test_the_permanent_stream_cannot_be_closed(stage: Stage) -> None:
    for name in (f"{SPACE}/snapshots", "/elsewhere"):
        assert (await stage.call("close", topic=name)).result is False
    assert f"{SPACE}/snapshots" in stage.streams.periods


async def test_an_abandoned_stream_is_closed(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    await stage.open("left")
    assert not stage.streams.read()
    assert len(stage.streams.periods) == 2
    monkeypatch.setattr(snapshot_streams, "ABANDONED", -1.0)
    stage.streams.read()
    assert list(stage.streams.periods) == [f"{SPACE}/snapshots"]


def test_the_topic_is_latched_and_has_the_expected_type(stage: Stage, graph: Any) -> None:
    (end,) = graph.publishers(f"{SPACE}/snapshots")
    assert (end.type, end.latched) == ("py_trees_ros_interfaces/msg/BehaviourTree", True)
    assert LATCHED.depth == 1


def test_a_missing_package_is_reported_with_a_solution(graph: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot_streams, "PACKAGE", "nobodys_interfaces")
    with pytest.raises(
        TypeNotInstalled, match=r"nobodys_interfaces/msg/BehaviourTree is not installed .* build a monitor image"
    ):
        Streams(graph, SPACE)
    assert not graph.publishers(f"{SPACE}/snapshots")
