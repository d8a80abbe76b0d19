"""A monitor that keeps the state of real topics, for tests."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message

from tests.support.notices import RecordedNotices
from understudy.api.kinds.state_spec import State
from understudy.api.protocol.kept_state import KeptState, Restored, RestoreReport
from understudy.failover.interfaces import Instance
from understudy.kube.agent_client import AgentGone
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.ros.runtime.graph_node import Graph
from understudy.state.state_store import StateSource, StateStore

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


ACTIVE = Instance("w-1", "uid-1", running=True)


STANDBY = Instance("w-2", "uid-2", running=True, pool="warm")


STATE = State.model_validate(
    {"keep": [{"topic": "/amcl_pose", "type": POSE, "restoreTo": "/initialpose"}], "margin": "100ms", "period": "50ms"}
)


class Agents:
    """What the agents answer, and what they were given."""

    def __init__(self) -> None:
        self.restored: list[tuple[str, KeptState]] = []
        self.refusal = ""
        self.answer: Mapping[str, Any] | None = None

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        self.restored.append((instance.name, state))
        if self.refusal:
            return state.none_restored(self.refusal)
        return RestoreReport(tuple(Restored(s.name, s.taken_at) for s in state.restored_samples))

    async def inspect(self, instance: Instance, body: Mapping[str, Any], within: float) -> Mapping[str, Any]:
        if self.answer is None:
            raise AgentGone("its agent is not connected")
        return self.answer


class Monitor:
    """The loop of a monitor, as far as it is about state."""

    def __init__(self, graph: Graph, folder: Path) -> None:
        self.agents, self.notices = Agents(), RecordedNotices()
        self.state_manager = StateManager(graph, StateStore(folder), self.agents, self.notices)  # type: ignore[arg-type]
        self.state, self.health, self.active = STATE, "Healthy", ACTIVE
        self.waiting: list[tuple[Instance, float]] = []
        self.source: StateSource | None = None

    async def until(
        self, holds: Callable[[], object], within: float = 25.0, each: Callable[[], None] = lambda: None
    ) -> None:
        """Go on looking until something holds."""
        end = time.monotonic() + within
        while not holds():
            assert time.monotonic() < end, f"not within {within} s"
            each()
            self.look()
            await asyncio.sleep(0.02)

    def look(self) -> None:
        """Evaluate once."""
        self.state_manager.take(self.state, {}, self.active.name)
        self.state_manager.judge(self.health, time.time())  # type: ignore[arg-type]
        self.state_manager.housekeeping(self.active, self.waiting, self.source)

    def x(self, onset: float | None = None) -> float | None:
        """Where the robot would be said to be."""
        samples = self.state_manager.select(time.time() if onset is None else onset).samples
        return (
            float(deserialize_message(samples[0].data, PoseWithCovarianceStamped).pose.pose.position.x)
            if samples
            else None
        )


@contextlib.contextmanager
def next_monitor(folder: Path) -> Iterator[Monitor]:
    """The monitor in the next container, with a node of its own."""
    graph = Graph("later")
    try:
        yield Monitor(graph, folder)
    finally:
        graph.close()
