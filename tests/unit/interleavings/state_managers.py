"""How a monitor keeps state: its own code keeps, stores and selects what the model's applications publish."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from tests.unit.interleavings.kept_states import KEPT, KeptStates
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scheduling import Process
from understudy.api.protocol.kept_state import KeptState
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.ros.observe.state_samples import Captured, StateSamples
from understudy.ros.runtime.graph_node import Graph
from understudy.state.state_store import StateStore

(_TOPIC,) = KEPT.keep


class Samples(StateSamples):
    """The samples of the active instance that a monitor receives."""

    waiting: Mapping[str, str] = {}
    problems: Mapping[str, str] = {}

    def __init__(self, process: Process, robots: Robots, workload: str) -> None:
        self._process, self._robots, self._workload = process, robots, workload
        self._name, self._last = "", 0.0

    def follow(self, topics: Mapping[str, str | None]) -> None:
        return

    def attribute(self, instances: Mapping[str, str], active: str) -> bool:
        changed, self._name = active != self._name, active
        return changed

    def drain(self) -> Iterator[Captured]:  # type: ignore[override]
        mine = (r for r in self._robots.running.values() if r.robot == self._workload and r.name == self._name)
        last = max((r.last_arrival(self._robots.now) or 0.0 for r in mine if r.through), default=0.0)
        if last > self._last:
            self._last, at = last, self._process.stamp(last)
            yield Captured(_TOPIC.topic, _TOPIC.type or "", repr(last).encode(), at, at, "")

    def shift(self, step: float) -> None:
        return


class ModelStateManager(StateManager):
    """The kept state of one workload, whose monitor has a folder."""

    def __init__(
        self,
        samples: Samples,
        states: KeptStates,
        workload: str,
        folder: Path,
        agents: AgentConnections,
        notices: Notices,
    ) -> None:
        super().__init__(cast(Graph, None), StateStore(folder), agents, notices)
        self._capturing, self._states, self._workload, self._folder = samples, states, workload, folder
        states.began(folder)

    def judge(self, health: Any, now: float) -> None:
        super().judge(health, now)
        for versions in self._keeper.versions().values():
            self._states.kept(self._folder, float(versions[-1].data), now)

    def select(self, onset: float) -> KeptState:
        state = super().select(onset)
        self._states.selected(self._workload, self._folder, state, onset, time.time())
        return state
