"""Runs the steps of a procedure on an instance: its leaves as py_trees behaviours over asynchronous actions.

A leaf starts its action at its first tick and sees the end of the action at a later one. An action that is no longer
needed is cancelled. Every action knows its remaining time, so that it can report itself what it was waiting for.
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
"""Seconds before the end of its time at which an action gives up on its own: its error message is better than that of a
timeout."""


OVERTIME = 0.5
"""Seconds after the end of its time at which an action is cancelled if it has not given up on its own, which may be
late on a busy node."""


class ProcedureFailed(Exception):
    """A procedure failed; the text names the leaf and says why."""


class Actions(Protocol):
    """The actions on one instance. Each raises an exception that says why it failed; ``within`` is a limit in
    seconds."""

    async def call(
        self, service: str, type_name: str, request: Mapping[str, Any], within: float, *, repeat: float | None = None
    ) -> dict[str, Any]:
        """Return the answer of a service. If ``repeat`` is given, the request is sent again after that many seconds
        without an answer."""

    async def service_present(self, service: str) -> bool:
        """Return whether the instance has this service."""

    async def node_present(self, node: str) -> bool:
        """Return whether the instance has a node of that full name."""

    async def lifecycle_state(self, node: str, within: float) -> str:
        """Return the state of a managed node."""

    async def bring_to(self, node: str, state: str, within: float) -> None:
        """Bring a managed node to a state."""

    async def get_parameters(self, node: str, names: Sequence[str], within: float) -> dict[str, Any]:
        """Return values of a node's parameters."""

    async def set_parameters(self, node: str, values: Mapping[str, Any], within: float) -> None:
        """Set a node's parameters."""

    async def publish(self, topic: str, type_name: str, message: Mapping[str, Any], within: float) -> None:
        """Publish a message to the instance."""

    async def wait_sample(self, topic: str, type_name: str, within: float) -> object:
        """Wait for a message."""

    async def restore_state(self, only: Sequence[str] | None, within: float) -> None:
        """Restore the kept state that came with the procedure: all of it, or only that of these topics and nodes."""

    async def resend_goals(self, within: float) -> None:
        """Request that unfinished goals are sent to the instance."""

    def health(self, tree: HealthTree) -> Verdict:
        """Return the verdict of a health tree on the instance now."""


Work = Callable[[Actions, float], Awaitable[None]]
"""Does something within the given seconds. Raises an exception if it fails."""


class TimeLimit:
    """A deadline that several leaves share."""

    def __init__(self) -> None:
        self.until = float("inf")
        """In the event loop's time."""


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
        """``limits`` are the deadlines that apply to it."""
        super().__init__(path)
        self.error = ""
        """Why it failed the last time."""
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
        """Return the status of the action."""
        assert self._task is not None, "it was started"
        if not self._task.done():
            return Status.RUNNING
        return Status.FAILURE if self._failed else Status.SUCCESS

    def terminate(self, new_status: Status) -> None:
        """Cancel the action if it still runs."""
        if self._task is not None and not self._task.done():
            self._task.cancel()


class Timeout(Decorator):
    """Fails if its child does not end in time."""

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
        """What had not ended when it failed the last time."""
        self._run, self._within, self._limit, self._above = run, within, limit, above

    def initialise(self) -> None:
        """Start the time."""
        self.error = ""
        self._limit.until = min([self._run.clock() + self._within, *(limit.until for limit in self._above)])

    def update(self) -> Status:
        """Return the child's status, or a failure after the end of the time."""
        if self.decorated.status == Status.RUNNING and self._run.clock() >= self._limit.until + OVERTIME:
            self.error = f"not done within {self._within:g} s: {'; '.join(unfinished(self.decorated))}"
            return Status.FAILURE
        return self.decorated.status


class Retry(Decorator):
    """Tries its child again after a failure."""

    def __init__(self, path: str, child: Behaviour, run: ProcedureRun, times: int, wait: float) -> None:
        super().__init__(path, child)
        self._run, self._times, self._wait = run, times, wait
        self._tries = 0
        self._again = 0.0

    def initialise(self) -> None:
        """Start the first attempt."""
        self._tries, self._again = 1, 0.0

    def tick(self) -> Iterator[Behaviour]:
        """Do not tick the child while it waits for the next attempt."""
        if self.status == Status.RUNNING and self._run.clock() < self._again:
            yield self
        else:
            yield from super().tick()

    def update(self) -> Status:
        """Return the child's status; a failure only if it was the last attempt."""
        if self.decorated.status != Status.FAILURE or self._tries >= self._times:
            return self.decorated.status
        self._tries += 1
        self._again = self._run.clock() + self._wait
        return Status.RUNNING


def reasons(node: Behaviour, *, inverted: bool = False) -> list[str]:
    """Return for each failed leaf of a node its path and its error."""
    if isinstance(node, Step):
        return [f"{node.name}: the condition is true, but must be false" if inverted else f"{node.name}: {node.error}"]
    if isinstance(node, Timeout) and node.error:
        return [f"{node.name}: {node.error}"]
    if isinstance(node, Decorator) and node.decorated.status != node.status:
        return reasons(node.decorated, inverted=True)
    wanted = Status.SUCCESS if inverted else Status.FAILURE
    return [reason for child in node.children if child.status == wanted for reason in reasons(child, inverted=inverted)]


def unfinished(node: Behaviour) -> list[str]:
    """Return the leaves that a running node still waits for, each with the error of its last failure, if any."""
    steps = [found for found in node.iterate() if isinstance(found, Step)]
    running = [
        f"{s.name} is still running{f', after {s.error}' if s.error else ''}"
        for s in steps
        if s.status == Status.RUNNING
    ]
    return running or [f"{s.name}: {s.error}" for s in steps if s.status == Status.FAILURE and s.error]
