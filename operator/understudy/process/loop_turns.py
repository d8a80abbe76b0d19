"""Measures how long an event loop is busy between two looks for what has arrived.

A turn of the loop runs everything that is due, and nothing else is served meanwhile. It costs four readings of clocks per
turn, and no wakeups. The thread's own processor time separates work from waiting for a processor, which a busy node causes.
The time of Python's garbage collection is known too, because it is not the fault of what the turn did. A collection visits every object
that the process holds. So what is left after a long one is exempt from later ones.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import selectors
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

from prometheus_client import CollectorRegistry, Histogram

_logger = logging.getLogger(__name__)

LONG = 0.05
"""Seconds from which on a turn is counted. Nearly all take less than 10 ms."""

REPORTED = 0.1
"""Seconds of processor time from which on a turn is logged, so that its cause can be found next to it in the log."""

LONG_COLLECTION = 0.02
"""Seconds of processor time from which on a collection of all objects is a long one."""

T = TypeVar("T")


_OLDEST = 2


@dataclass(frozen=True)
class Turn:
    """A long turn of an event loop, in seconds."""

    took: float
    used: float
    """Processor time."""
    collected: float = 0.0
    """Processor time of garbage collection, which is a part of ``used``."""


Report = Callable[[Turn], None]


class TurnTimer(selectors.DefaultSelector):
    """The selector of an event loop, which measures the time between its calls."""

    def __init__(self, report: Report) -> None:
        super().__init__()
        self._report = report
        self._began: float | None = None
        self._used = self._collected = self._collection_began = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for events, as every selector does."""
        if self._began is not None and (took := time.monotonic() - self._began) >= LONG:
            self._report(Turn(took, time.thread_time() - self._used, self._collected))
        found = super().select(timeout)
        self._began, self._used, self._collected = time.monotonic(), time.thread_time(), 0.0
        return found

    def collection(self, phase: str, info: dict[str, int]) -> None:
        """Note the begin or the end of a garbage collection, as a member of ``gc.callbacks``.

        After a long collection of all objects, those that are left are exempt from later ones. Copies of API objects have no cycles, so
        they are freed as before when nothing refers to them.
        """
        if phase == "start":
            self._collection_began = time.thread_time()
            return
        took = time.thread_time() - self._collection_began
        self._collected += took
        if info["generation"] == _OLDEST and took >= LONG_COLLECTION:
            gc.freeze()


def run(main: Coroutine[Any, Any, T], report: Report) -> T:
    """Run a coroutine as :func:`asyncio.run` does, and report the long turns of its event loop."""
    timer = TurnTimer(report)
    gc.callbacks.append(timer.collection)
    try:
        with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(timer)) as runner:
            return runner.run(main)
    finally:
        gc.callbacks.remove(timer.collection)


def series(registry: CollectorRegistry) -> Histogram:
    """Create the metric of one process."""
    return Histogram(
        "understudy_event_loop_busy_seconds",
        "Turns of the event loop of at least 50 ms, in which the process serves nothing else; time is elapsed, or processor for the "
        "processor time that they used, which is less if the node is busy.",
        ["time"],
        registry=registry,
        buckets=(0.05, 0.1, 0.2, 0.5, 1, 2, 5),
    )


def reporter(histogram: Histogram) -> Report:
    """Return what counts the long turns of a process in its metric, and logs those of much processor time."""
    elapsed, processor = histogram.labels(time="elapsed"), histogram.labels(time="processor")

    def report(turn: Turn) -> None:
        elapsed.observe(turn.took)
        processor.observe(turn.used)
        if turn.used >= REPORTED:
            _logger.info(
                "the event loop was busy for %.3f s, of which %.3f s were processor time, and %.3f s of these garbage collection",
                turn.took,
                turn.used,
                turn.collected,
            )

    return report
