"""The monitor tells ROS tools how the workload is: read by processes of their own, over real DDS."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.support.golden import assert_golden
from tests.unit.dds import isolate_discovery
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.diagnosed_tree import TREE
from tests.unit.monitor.senses import GivenObserver
from tests.unit.ros.processes import Processes
from understudy.api.kinds.robot_workload import GateStatus
from understudy.monitor.notices import Notices
from understudy.monitor.report.diagnostics_publisher import DiagnosticsPublisher, namespace_of
from understudy.ros.actions import snapshot_streams

pytestmark = pytest.mark.ros


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from understudy.ros.runtime.graph_node import Graph

    isolate_discovery(monkeypatch)
    made = Graph("understudy_monitor")
    yield made
    made.close()


@pytest.fixture
def processes(graph: Any) -> Iterator[Processes]:
    started = Processes()
    yield started
    started.end()


class Monitor:
    """A monitor without a cluster: what it tells, and what there is to tell."""

    def __init__(self, graph: Any) -> None:
        self._objects = ClusterObjects(workload="robot-1-drive")
        self.ask()
        observer = GivenObserver()
        observer.graph, observer.tree = graph, TREE
        self.notices = Notices()
        self.telling = DiagnosticsPublisher(self._objects.view, observer, self.notices)

    def ask(self, **settings: bool) -> None:
        """Change the workload's spec, as a user does."""
        self._objects.put_workload(status={"standby": "Executing (1/1)"}, monitor=settings)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self.telling.run())
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


async def until(holds: Any) -> None:
    async with asyncio.timeout(25):
        while not holds():
            await asyncio.sleep(0.02)


async def line(processes: Processes, node: Any) -> Any:
    return json.loads(await asyncio.to_thread(processes.line, node, 25))


async def test_diagnostics_show_a_failover_from_ok_to_error_to_ok(graph: Any, processes: Processes) -> None:
    monitor, reader = Monitor(graph), processes.node("diagnoses", script="viewing.py")
    monitor.ask(diagnostics=True)
    say = monitor.notices
    say.set(active="w-1", health="Healthy", strategy="Executing", gate=GateStatus(epoch=3, active="w-1"))
    async with monitor.running():
        first = await line(processes, reader)
        assert (first["level"], first["name"], first["message"]) == (
            0,
            "understudy: robot-1-drive",
            "w-1 is in control",
        )
        assert first["values"]["standby"] == "Executing (1/1)"
        assert first["values"]["leaf scan"] == "Healthy"
        again = await line(processes, reader)
        assert again["level"] == 0
        assert again["at"] > first["at"], "it is said again and again"

        # All within one turn of the loop, as fast as a switch to an executing standby may be.
        say.set(health="Failed")
        say.condition("Recovering", "True", "FailureDetected", "no /cmd_vel for 500 ms")
        say.set(health="Recovering")
        say.set(active="w-2", gate=GateStatus(epoch=4, active="w-2"))
        say.condition("Recovering", "False", "Recovered", "w-2 took over from w-1")
        say.set(health="Healthy")
        while (failed := await line(processes, reader))["level"] == 0:
            assert failed["values"]["in control"] == "w-1", "the failure comes before what came of it"
        assert (failed["level"], failed["message"]) == (2, "no /cmd_vel for 500 ms")
        assert (failed["values"]["in control"], failed["values"]["gate epoch"]) == ("w-1", "3")
        after = await line(processes, reader)
        assert (after["level"], after["message"]) == (0, "w-2 is in control")
        assert after["values"]["gate epoch"] == "4"
        assert after["at"] >= failed["at"]


async def test_diagnostics_are_published_only_if_the_spec_enables_them(graph: Any) -> None:
    monitor = Monitor(graph)
    monitor.notices.set(active="w-1", health="Healthy")
    async with monitor.running():
        await asyncio.sleep(0.1)
        monitor.notices.set(health="Failed")
        await asyncio.sleep(0.1)
        assert not graph.publishers("/diagnostics")
        assert not [name for name, _ in graph.node.get_topic_names_and_types() if name.startswith("/understudy")]
        monitor.ask(diagnostics=True)
        await until(lambda: graph.publishers("/diagnostics"))
        monitor.ask()
        await until(lambda: not graph.publishers("/diagnostics"))


async def test_a_viewer_finds_and_draws_the_tree(graph: Any, processes: Processes) -> None:
    monitor = Monitor(graph)
    monitor.ask(snapshots=True)
    async with monitor.running():
        viewer = processes.node("open", "/understudy/robot_1_drive", "inf", script="viewing.py")
        assert await line(processes, viewer) == "/understudy/robot_1_drive/snapshot_streams/_snapshots_0"
        drawn = (await line(processes, viewer))["drawn"]
        assert len(drawn) == 3
        assert drawn[2].endswith("-- no /cmd_vel for 500 ms")


async def test_an_unpublishable_topic_is_reported_and_the_others_are_published(
    graph: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshot_streams, "PACKAGE", "nobodys_interfaces")
    monitor = Monitor(graph)
    monitor.ask(diagnostics=True, snapshots=True)
    async with monitor.running():
        await until(lambda: monitor.telling.problems)
        await until(lambda: graph.publishers("/diagnostics"))
        (problem,) = monitor.telling.problems
        assert_golden("monitor", problem, "spec.monitor.snapshots", "nobodys_interfaces", "spec.monitor.image")
        monitor.ask(diagnostics=True)
        await until(lambda: not monitor.telling.problems)
        assert graph.publishers("/diagnostics")


@pytest.mark.parametrize(
    ("workload", "namespace"),
    [("robot-17.nav", "/understudy/robot_17_nav"), ("17-drive", "/understudy/_17_drive")],
)
def test_the_namespace_of_the_topics_is_a_valid_ros_name(workload: str, namespace: str) -> None:
    assert namespace_of(workload) == namespace
