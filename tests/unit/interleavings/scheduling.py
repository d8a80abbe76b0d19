"""An event loop in virtual time whose seed decides which process goes on next.

Within a process callbacks keep the order that asyncio promises. Between processes nothing is promised: one that could go on is
chosen at random at every step, and time only passes when none can. A process that is killed never goes on, and nothing of it
runs any more, not even what its code would do at the end: as with SIGKILL.
"""

from __future__ import annotations

import asyncio
import contextvars
import heapq
import math
import random
from asyncio import events
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any

_process: contextvars.ContextVar[Process] = contextvars.ContextVar("process")


MANY = 100
"""Tasks of a process after which those that are done are forgotten."""


PATIENCE = 10_000
"""How often a process may ask for the time within one step."""


class Killed(BaseException):
    """The process ends here, whatever it was about to catch."""


class Stuck(BaseException):
    """A process goes on and on, and never lets another one go on."""


class Process:
    """What runs, stalls and is killed as one."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True
        self.stalled = False
        self.clock_steps: list[tuple[float, float]] = [(-math.inf, 0.0)]
        """From which time on its clock differs from the world's, by how many seconds."""
        self.ready: deque[asyncio.Handle] = deque()
        self.tasks: list[asyncio.Task[Any]] = []
        self.context = contextvars.copy_context()
        self.context.run(_process.set, self)

    def stamp(self, moment: float) -> float:
        """A time of the world, in Unix seconds, as its clock showed it."""
        return moment + next(offset for since, offset in reversed(self.clock_steps) if since <= moment)

    def kill(self) -> None:
        """End it at once."""
        self.alive = False

    def __repr__(self) -> str:
        return self.name


def current() -> Process | None:
    """The process whose code is running."""
    return _process.get(None)


class VirtualLoop(asyncio.AbstractEventLoop):
    """Runs processes step by step."""

    def __init__(self, choices: random.Random, *, now: float = 0.0) -> None:
        self._choices = choices
        self._now = now
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        self._count = 0
        self.steps = self._asked = 0
        self._runnable: list[Process] = []
        """Those with something to do; dead and stalled ones too."""
        self._everybody: list[Process] = []
        self.tcp: Any = None
        """What connects processes (tcp.py)."""
        self.surprised: Callable[[Process, BaseException | None, str], None] = lambda process, error, message: None
        """Called with what nobody has caught."""

    # -- for the simulation -----------------------------------------------------------------------------------------

    def process(self, name: str) -> Process:
        """A new process."""
        made = Process(name)
        self._everybody.append(made)
        return made

    def start(self, process: Process, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Run something in a process."""
        return process.context.run(self.create_task, work)

    def stall(self, process: Process, seconds: float, by: Process) -> None:
        """Let a process not go on for so long."""
        process.stalled = True
        self.call_later(seconds, setattr, process, "stalled", False, context=by.context)

    def step(self) -> None:
        """One callback of one process, or else the passing of time."""
        self.steps += 1
        self._asked = 0
        ready = [p for p in self._runnable if p.alive and not p.stalled]
        if not ready:
            self._advance()
            return
        process = ready[0] if len(ready) == 1 else ready[int(self._choices.random() * len(ready))]
        handle = process.ready.popleft()
        if not process.ready:
            self._runnable.remove(process)
        if not handle.cancelled():
            handle._run()

    def _advance(self) -> None:
        when, _, _ = self._timers[0]
        self._now = max(self._now, when)
        while self._timers and self._timers[0][0] <= self._now:
            handle = heapq.heappop(self._timers)[2]
            if not handle.cancelled():
                self._ready(handle)

    def _ready(self, handle: asyncio.Handle) -> None:
        process = handle._context.get(_process)  # type: ignore[attr-defined]
        assert process is not None, "everything that runs belongs to a process"
        if not process.ready:
            self._runnable.append(process)
        process.ready.append(handle)

    def run(self, going_on: Callable[[], bool]) -> None:
        """Step by step, for as long as this holds."""
        events._set_running_loop(self)
        try:
            while going_on():
                self.step()
        finally:
            events._set_running_loop(None)

    def dispose(self) -> None:
        """Unwind all that is under way, of what was killed too: what is merely dropped would complain."""
        for process in self._everybody:
            process.alive, process.stalled = True, False
            for task in process.tasks:
                task.cancel()
        self._timers.clear()
        self.run(lambda: bool(self._runnable))

    # -- for asyncio ------------------------------------------------------------------------------------------------

    def clock(self) -> float:
        """The time, for code that may ask for it again and again. Raises Stuck."""
        self._asked += 1
        if self._asked > PATIENCE:
            raise Stuck
        return self._now

    def time(self) -> float:
        return self._now

    def call_soon(self, callback: Callable[..., Any], *args: Any, context: Any = None) -> asyncio.Handle:
        handle = asyncio.Handle(callback, args, self, context)
        self._ready(handle)
        return handle

    def call_later(self, delay: float, callback: Callable[..., Any], *args: Any, context: Any = None) -> Any:
        return self.call_at(self._now + delay, callback, *args, context=context)

    def call_at(self, when: float, callback: Callable[..., Any], *args: Any, context: Any = None) -> Any:
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        self._count += 1
        heapq.heappush(self._timers, (when, self._count, handle))
        return handle

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        return

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task(self, coro: Any, *, name: str | None = None, context: Any = None) -> asyncio.Task[Any]:
        task: asyncio.Task[Any] = (
            asyncio.Task(coro, loop=self, name=name)
            if context is None
            else asyncio.Task(coro, loop=self, name=name, context=context)
        )
        # One that is killed with its process is no mistake.
        task._log_destroy_pending = False  # type: ignore[attr-defined]
        tasks = (context.get(_process) if context is not None else _process.get()).tasks
        if len(tasks) > MANY:
            tasks[:] = [other for other in tasks if not other.done()]
        tasks.append(task)
        return task

    async def create_connection(self, factory: Any, host: Any = None, port: Any = None, **_: Any) -> Any:  # type: ignore[override]
        return await self.tcp.connect(factory, host)

    async def create_server(self, factory: Any, host: Any = None, port: Any = None, **_: Any) -> Any:  # type: ignore[override]
        return await self.tcp.serve(factory, host)

    async def create_unix_connection(self, factory: Any, path: Any = None, **_: Any) -> Any:  # type: ignore[override]
        return await self.tcp.connect(factory, str(path))

    async def create_unix_server(self, factory: Any, path: Any = None, **_: Any) -> Any:  # type: ignore[override]
        return await self.tcp.serve(factory, str(path))

    def add_signal_handler(self, *_: Any) -> None:
        return

    def run_in_executor(self, executor: Any, func: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        done = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:
            done.set_exception(error)
        return done

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return True

    def is_closed(self) -> bool:
        return False

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        self.surprised(_process.get(None), context.get("exception"), context["message"])  # type: ignore[arg-type]
