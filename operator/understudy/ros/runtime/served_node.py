"""A node whose entities are served by one thread of its own, for a process that runs asyncio.

The entities are services, clients and subscriptions. rclpy's executors build a new wait set for every wake-up, which
costs a multiple of the work itself. Here the set is built only when the entities change. Everything of ROS happens in
the thread, everything else in the event loop. The thread passes received data to the loop, and the loop passes work to
the thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Literal, TypeVar

from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from understudy.ros.runtime.node_options import own_context, plain_node
from understudy.ros.runtime.sample_taking import SampleTaker
from understudy.ros.runtime.service_exchange import ServiceExchange

_logger = logging.getLogger(__name__)

T = TypeVar("T")
Kind = Literal["subscription", "client", "service"]

_NS = 1_000_000_000
_LONGEST = 1.0
"""Maximum seconds of one wait, so that a thread that missed a wake-up continues."""


def ignore_message(message: object) -> None:
    """Satisfy rclpy, which requires a callback for each subscription, although the node's thread takes the messages."""


class ServedNode:
    """A node and the thread that serves it."""

    def __init__(self, name: str, *, context: Context | None = None) -> None:
        """Join the graph as node ``name``, in an existing context or in one of its own.

        Needs a running event loop, which receives everything that arrives.
        """
        self._loop = asyncio.get_running_loop()
        self._own_context = context is None
        if context is None:
            context = own_context()
        self._context = context
        self.node = plain_node(name, context)
        self.taker, self.exchange = SampleTaker(), ServiceExchange()
        self._entities: dict[Kind, list[tuple[Any, Callable[[], None]]]] = {
            "subscription": [],
            "client": [],
            "service": [],
        }
        self._work: deque[Callable[[], None]] = deque()
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._stopped = False
        self._turned = time.monotonic()
        with context.handle:
            self._wake = _rclpy.GuardCondition(context.handle)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    # -- from the loop ----------------------------------------------------------------------------------------------

    def do(self, work: Callable[[], None]) -> None:
        """Let the thread carry out some work, in the order of the calls. Errors are logged."""
        self._work.append(work)
        with self._wake:
            self._wake.trigger_guard_condition()

    async def get(self, work: Callable[[], T]) -> T:
        """Let the thread carry out some work, and return its result. Raises what the work raises."""
        future: Future[T] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return  # the caller no longer waits
            try:
                future.set_result(work())
            except BaseException as error:
                future.set_exception(error)

        self.do(run)
        return await asyncio.wrap_future(future)

    @property
    def silent_for(self) -> float:
        """Seconds since the thread's last round. More than its longest piece of work plus one second means that it
        hangs."""
        return time.monotonic() - self._turned

    @property
    def alive(self) -> bool:
        """Whether the node's context is still valid. If another component shuts the context down, the thread ends."""
        return bool(self._context.ok())

    async def close(self) -> None:
        """Leave the graph."""
        await asyncio.to_thread(self.shut_down)

    def shut_down(self) -> None:
        """Leave the graph, and wait for the thread to end."""
        self._stopped = True
        if self.alive:
            self.do(lambda: None)
        self._thread.join()
        if self.alive or self._own_context:
            self.node.destroy_node()
        if self._own_context:
            self._context.try_shutdown()

    # -- from the thread --------------------------------------------------------------------------------------------

    def add(self, kind: Kind, entity: Any, on_ready: Callable[[], None]) -> None:
        """Call ``on_ready`` in the thread whenever there is something to take from one of the node's entities."""
        self._entities[kind].append((entity, on_ready))

    def remove(self, kind: Kind, entity: Any) -> None:
        """Stop serving an entity, and destroy it."""
        self._entities[kind] = [entry for entry in self._entities[kind] if entry[0] is not entity]
        getattr(self.node, f"destroy_{kind}")(entity)

    def call_in_loop(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function in the event loop."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, *arguments)

    def after(self, seconds: float, work: Callable[[], None]) -> None:
        """Carry out some work after ``seconds``."""
        self._later.append((time.monotonic() + seconds, work))

    def _run(self) -> None:
        while not self._stopped and self._context.ok():
            try:
                self._serve()
            except Exception:
                if self._stopped or not self._context.ok():
                    return
                _logger.exception("serving %s", self.node.get_name())
                time.sleep(0.1)

    def _serve(self) -> None:
        """Build the wait set and use it until the entities change."""
        built = self._snapshot()
        counts = {kind: len(entries) for kind, entries in built.items()}
        with contextlib.ExitStack() as stack:
            for entries in built.values():
                for entity, _ in entries:
                    stack.enter_context(entity.handle)
            stack.enter_context(self._context.handle)
            stack.enter_context(self._wake)
            wait_set = _rclpy.WaitSet(
                counts["subscription"], 1, 0, counts["client"], counts["service"], 0, self._context.handle
            )
            stack.enter_context(wait_set)
            while not self._stopped:
                self._turned = time.monotonic()
                wait_set.clear_entities()
                wait_set.add_guard_condition(self._wake)
                for kind, entries in built.items():
                    for entity, _ in entries:
                        getattr(wait_set, f"add_{kind}")(entity.handle)
                wait_set.wait(self._timeout())
                ready = [
                    on_ready
                    for kind, entries in built.items()
                    for index, (_, on_ready) in enumerate(entries)
                    if wait_set.is_ready(kind, index)
                ]
                for on_ready in ready:
                    self._guarded(on_ready)
                self._run_work()
                if self._snapshot() != built:
                    return

    def _snapshot(self) -> dict[Kind, Sequence[tuple[Any, Callable[[], None]]]]:
        return {kind: tuple(entries) for kind, entries in self._entities.items()}

    def _timeout(self) -> int:
        """Return the nanoseconds until something is due."""
        if self._work:
            return 0
        due = min((moment for moment, _ in self._later), default=float("inf"))
        return int(max(0.0, min(_LONGEST, due - time.monotonic())) * _NS)

    def _run_work(self) -> None:
        now = time.monotonic()
        due = [entry for entry in self._later if entry[0] <= now]
        self._later = [entry for entry in self._later if entry[0] > now]
        for _, work in due:
            self._guarded(work)
        for _ in range(len(self._work)):
            self._guarded(self._work.popleft())

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception:
            _logger.exception("in the ROS thread of %s", self.node.get_name())
