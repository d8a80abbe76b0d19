"""The applications that work on goals, and the agents' part in it: the real code over an action server of the model."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from understudy.action_proxy.client_goals import ABORTED, CANCELED, EXECUTING, SUCCEEDED, UNKNOWN
from understudy.action_proxy.goal_ledger import CANCEL_ENDED, CANCEL_OK, CANCEL_UNKNOWN
from understudy.agent.restoration.task_goals import TaskGoals
from understudy.ros.actions.action_endpoints import ActionClient

TICK = 0.1
"""Seconds between two steps of the work on a goal."""

REJECTED = 0.02
"""How often an application rejects a goal."""


class Witness(Protocol):
    """Learns what applications do with goals."""

    def begun(self, found: Running, goal: str) -> None:
        """An instance begins to work on a client's goal."""

    def completed(self, found: Running, goal: str) -> None:
        """An instance has reached a client's goal."""

    def replaced(self, found: Running, goal: str) -> None:
        """An instance has ended a client's goal for a newer one."""


def data_of(goal: str, lasts: float) -> bytes:
    """Return the content of a goal: the id that its client gave it, and the seconds of work that it takes."""
    return json.dumps({"goal": goal, "lasts": lasts}).encode()


@dataclass
class Execution:
    """The work on one goal."""

    goal: str
    lasts: float
    done: float = 0.0
    status: int = EXECUTING
    cancelled: bool = False


class Application:
    """The action server in one pod, which forgets everything when its process ends."""

    def __init__(self, robots: Robots, found: Running, witness: Witness) -> None:
        self._robots, self._found, self._witness = robots, found, witness
        self._process = found.restarts
        self._goals: dict[str, Execution] = {}
        self._is_ending = False

    @property
    def serving(self) -> set[bytes]:
        """What identifies the process that serves; empty if none does."""
        found = self._found
        return {f"{found.uid} {found.restarts}".encode()} if found.up and not (found.ended or found.held) else set()

    @property
    def goals(self) -> dict[str, Execution]:
        """Those that the present process knows, by the ids that they have here."""
        if self._process != self._found.restarts:
            self._process, self._goals = self._found.restarts, {}
        return self._goals

    async def answers(self) -> None:
        """Wait until the process answers a request. It never does if it ends before."""
        asked = self.serving
        await asyncio.sleep(self._robots.between(0.0005, 0.01))
        while not self._found.sends or self._is_ending:
            await asyncio.sleep(TICK)
        if self.serving != asked:
            await asyncio.get_running_loop().create_future()

    async def ended(self, execution: Execution, goals: Mapping[str, Execution]) -> None:
        """Wait for the end of the work on a goal. It is not known if the process ends before."""
        while execution.status == EXECUTING or goals is not self.goals or not self._found.sends:
            await asyncio.sleep(TICK)

    def accept(self, id: str, data: bytes) -> bool:
        """Begin to work on a goal, and no longer on an older one. Returns whether it is accepted."""
        if id in self.goals or self._robots.choices.random() < REJECTED:
            return False
        content = json.loads(data)
        for other in self.goals.values():
            if other.status == EXECUTING:
                other.status = ABORTED
                self._witness.replaced(self._found, other.goal)
        made = self.goals[id] = Execution(content["goal"], content["lasts"])
        self._witness.begun(self._found, made.goal)
        self._robots.later(TICK, self._work, made, self.goals)
        return True

    def _work(self, execution: Execution, goals: Mapping[str, Execution]) -> None:
        if goals is not self.goals or self._found.ended or execution.status != EXECUTING:
            return
        if self._found.sends:
            execution.done += TICK
            if execution.cancelled:
                execution.status = CANCELED
            elif execution.done >= execution.lasts:
                execution.status = SUCCEEDED
                self._witness.completed(self._found, execution.goal)
        self._robots.later(TICK, self._work, execution, goals)

    def abort(self) -> None:
        """End all goals, as applications do at the signal to end. They answer no request any more, except for results."""
        self._is_ending = True
        for execution in self.goals.values():
            if execution.status == EXECUTING:
                execution.status = ABORTED


class Client:
    """Stands in for :class:`understudy.ros.actions.action_endpoints.ActionClient`."""

    def __init__(self, application: Application) -> None:
        self._application = application

    async def ready(self) -> bool:
        return bool(self._application.serving)

    async def send_goal(self, id: str, data: bytes) -> tuple[bool, int]:
        await self._application.answers()
        return self._application.accept(id, data), 0

    async def result(self, id: str) -> tuple[int, bytes]:
        await self._application.answers()
        goals = self._application.goals
        if (found := goals.get(id)) is None:
            return UNKNOWN, b""
        await self._application.ended(found, goals)
        return found.status, b"result"

    async def cancel(self, id: str) -> int:
        await self._application.answers()
        if (found := self._application.goals.get(id)) is None:
            return CANCEL_UNKNOWN
        if found.status != EXECUTING:
            return CANCEL_ENDED
        found.cancelled = True
        return CANCEL_OK


class PodGoals(TaskGoals):
    """The goals at one pod's application."""

    def __init__(self, application: Application, publish: Callable[[Mapping[str, Any]], None]) -> None:
        super().__init__("goals", lambda: None, publish)
        self._application = application

    async def _server(self, record: object) -> ActionClient:
        return cast(ActionClient, Client(self._application))

    async def _serving(self, action: str) -> set[bytes]:
        return self._application.serving

    def _moved(self) -> bool:
        return False
