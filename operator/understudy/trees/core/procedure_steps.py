"""What a procedure does to an instance: its leaves as py_trees behaviours over asynchronous actions.

A leaf starts its action at its first tick and sees its end at a later one; an action that is no longer wanted is
cancelled. Every action knows how much time is left for it, so that it can say on its own what it was waiting for.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.decorators import Decorator

from understudy.trees.core.health_tree import HealthTree, Verdict

MARGIN = 0.1
"""Seconds before the end of its time at which an action gives up on its own, with better words than who cuts it short."""


OVERTIME = 0.5
"""Seconds after the end of its time at which an action is cut short that should have given up on its own: on a busy node it
may come to that late.
"""


class ProcedureFailed(Exception):
    """A procedure failed; the text names the leaf and says why."""


class Actions(Protocol):
    """The actions on one instance. Each raises an exception that says why it failed; times are bounds in seconds."""

    async def call(
        self, service: str, type_name: str, request: Mapping[str, Any], within: float, *, repeat: float | None = None
    ) -> dict[str, Any]:
        """The answer of a service, which is asked again after so many seconds without one where ``repeat`` is given."""

    async def service_present(self, service: str) -> bool:
        """Whether the instance serves it."""

    async def node_present(self, node: str) -> bool:
        """Whether the instance has a node of that full name."""

    async def lifecycle_state(self, node: str, within: float) -> str:
        """The state of a managed node."""

    async def bring_to(self, node: str, state: str, within: float) -> None:
        """Bring a managed node to a state."""

    async def get_parameters(self, node: str, names: Sequence[str], within: float) -> dict[str, Any]:
        """Values of a node's parameters."""

    async def set_parameters(self, node: str, values: Mapping[str, Any], within: float) -> None:
        """Set a node's parameters."""

    async def publish(self, topic: str, type_name: str, message: Mapping[str, Any], within: float) -> None:
        """Publish a message to the instance."""

    async def wait_sample(self, topic: str, type_name: str, within: float) -> object:
        """Wait for a message."""

    async def restore_state(self, only: Sequence[str] | None, within: float) -> None:
        """Give it the kept state that came with the procedure: all of it, or only of these topics and nodes."""

    async def resend_goals(self, within: float) -> None:
        """Have unfinished goals sent to it."""

    def health(self, tree: HealthTree) -> Verdict:
        """A health tree's verdict on it now."""


Work = Callable[[Actions, float], Awaitable[None]]
"""Does something within so many seconds. Raises what it failed by."""


class TimeLimit:
    """A deadline that leaves share."""

    def __init__(self) -> None:
        self.until = float("inf")
        """By the event loop's clock."""


class ProcedureRun:
    """One run of a procedure, shared by its nodes."""

    def __init__(self, actions: Actions) -> None:
        self.actions = actions
        self.wake = asyncio.Event()
        """Set when an action has ended."""
        self.tasks: set[asyncio.Task[None]] = set()
        self.clock = asyncio.get_running_loop().time


class Step(Behaviour):
    """One action."""

    def __init__(self, path: str, work: Work, run: ProcedureRun, limits: Sequence[TimeLimit]) -> None:
        """``limits`` are the ends of time that hold for it."""
        super().__init__(path)
        self.error = ""
        """Why it failed, the last time it did."""
        self._work, self._run, self._limits = work, run, limits
        self._task: asyncio.Task[None] | None = None
        self._failed = False

    def initialise(self) -> None:
        """Start the action."""
        self._failed = False
        self._task = asyncio.create_task(self._act(), name=self.name)
        self._run.tasks.add(self._task)
        self._task.add_done_callback(self._run.tasks.discard)

    async def _act(self) -> None:
        left = min(limit.until for limit in self._limits) - self._run.clock()
        try:
            await self._work(self._run.actions, max(0.01, left - min(MARGIN, left / 10)))
        except Exception as error:
            self._failed, self.error = True, str(error) or repr(error)
        finally:
            self._run.wake.set()

    def update(self) -> Status:
        """How far it is."""
        assert self._task is not None, "it was started"
        if not self._task.done():
            return Status.RUNNING
        return Status.FAILURE if self._failed else Status.SUCCESS

    def terminate(self, new_status: Status) -> None:
        """Cancel what still runs."""
        if self._task is not None and not self._task.done():
            self._task.cancel()


class Timeout(Decorator):
    """Fails when its node is not done in its time."""

    def __init__(
        self,
        path: str,
        child: Behaviour,
        run: ProcedureRun,
        within: float,
        limit: TimeLimit,
        above: Sequence[TimeLimit],
    ) -> None:
        super().__init__(path, child)
        self.error = ""
        """What was not done, the last time it was not."""
        self._run, self._within, self._limit, self._above = run, within, limit, above

    def initialise(self) -> None:
        """The time begins."""
        self.error = ""
        self._limit.until = min([self._run.clock() + self._within, *(limit.until for limit in self._above)])

    def update(self) -> Status:
        """The node's own, or a failure when its time is over."""
        if self.decorated.status == Status.RUNNING and self._run.clock() >= self._limit.until + OVERTIME:
            self.error = f"not done within {self._within:g} s: {'; '.join(unfinished(self.decorated))}"
            return Status.FAILURE
        return self.decorated.status


class Retry(Decorator):
    """Tries its node again after a failure."""

    def __init__(self, path: str, child: Behaviour, run: ProcedureRun, times: int, wait: float) -> None:
        super().__init__(path, child)
        self._run, self._times, self._wait = run, times, wait
        self._tries = 0
        self._again = 0.0

    def initialise(self) -> None:
        """The first try."""
        self._tries, self._again = 1, 0.0

    def tick(self) -> Iterator[Behaviour]:
        """Leave the node alone while it waits for its next try."""
        if self.status == Status.RUNNING and self._run.clock() < self._again:
            yield self
        else:
            yield from super().tick()

    def update(self) -> Status:
        """The node's own, but for a failure that is not the last."""
        if self.decorated.status != Status.FAILURE or self._tries >= self._times:
            return self.decorated.status
        self._tries += 1
        self._again = self._run.clock() + self._wait
        return Status.RUNNING


def reasons(node: Behaviour, *, inverted: bool = False) -> list[str]:
    """Why a node failed, leaf by leaf: its path and what was wrong."""
    if isinstance(node, Step):
        return [f"{node.name}: it holds, which must not be" if inverted else f"{node.name}: {node.error}"]
    if isinstance(node, Timeout) and node.error:
        return [f"{node.name}: {node.error}"]
    if isinstance(node, Decorator) and node.decorated.status != node.status:
        return reasons(node.decorated, inverted=True)
    wanted = Status.SUCCESS if inverted else Status.FAILURE
    return [reason for child in node.children if child.status == wanted for reason in reasons(child, inverted=inverted)]


def unfinished(node: Behaviour) -> list[str]:
    """The leaves that a running node still waits for, each with what it last failed by, if it did."""
    steps = [found for found in node.iterate() if isinstance(found, Step)]
    running = [
        f"{s.name} is still running{f', after {s.error}' if s.error else ''}"
        for s in steps
        if s.status == Status.RUNNING
    ]
    return running or [f"{s.name}: {s.error}" for s in steps if s.status == Status.FAILURE and s.error]
