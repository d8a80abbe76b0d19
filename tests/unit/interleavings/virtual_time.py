"""The product's clocks, random identifiers and log are those of the run."""

from __future__ import annotations

import contextlib
import logging
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, tzinfo
from unittest import mock

from tests.unit.interleavings.apiserver import EPOCH
from tests.unit.interleavings.scheduling import current
from tests.unit.interleavings.senses import SafeCommander
from tests.unit.interleavings.simulated_cluster import SimulatedCluster
from understudy.api import conditions
from understudy.clock import CLOCK
from understudy.controller.pods.pool_pods import UniqueValues
from understudy.controller.reconcile import reconciler
from understudy.failover import progress
from understudy.kube import leader_election
from understudy.monitor import loop as supervising
from understudy.monitor.act import safe_commands

TICK = 1.0
"""Seconds between a monitor's looks while nothing wakes it. The simulated senses wake it whenever what they say changes."""


@dataclass(frozen=True)
class Identifiers:
    """Stands in for the module uuid."""

    uuid4: Callable[[], uuid.UUID]


@dataclass(frozen=True)
class Calendar:
    """Stands in for the class datetime."""

    now: Callable[[tzinfo], datetime]


@dataclass(frozen=True)
class Clock:
    """Stands in for the module time."""

    time: Callable[[], float]


def _stamped(moment: float) -> float:
    process = current()
    return process.stamp(moment) if process is not None else moment


@contextlib.contextmanager
def in_virtual_time(cluster: SimulatedCluster) -> Iterator[None]:
    loop, choices = cluster.loop, cluster.choices
    with contextlib.ExitStack() as stack:
        stack.callback(CLOCK.restart)
        for target, attribute, value in (
            (time, "time", lambda: _stamped(EPOCH + loop.clock())),
            (time, "monotonic", loop.clock),
            # Only there: trees have identifiers too, and are remembered from one run to the next.
            (progress, "uuid", Identifiers(lambda: uuid.UUID(int=choices.getrandbits(128)))),
            (
                conditions,
                "datetime",
                Calendar(lambda zone: datetime.fromtimestamp(EPOCH + loop.time(), zone)),
            ),
            (leader_election, "_now", lambda: f"{loop.time():.6f}"),
            (reconciler, "fresh", lambda: UniqueValues(name=cluster.next_name, token=lambda: "token")),
            (supervising, "TICK", TICK),
            (safe_commands, "Commander", SafeCommander),
            *cluster.patches(),
        ):
            stack.enter_context(mock.patch.object(target, attribute, value))
        stack.enter_context(_logging(cluster))
        CLOCK.restart()
        yield


@contextlib.contextmanager
def _logging(cluster: SimulatedCluster) -> Iterator[None]:
    """What the code logs belongs to the trace; without one nothing is logged."""
    logger = logging.getLogger("understudy")
    level, propagates = logger.level, logger.propagate

    class Tracing(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            cluster.note(f"{current()}: {record.levelname}: {record.getMessage()}")

    handler = Tracing()
    logger.addHandler(handler)
    logger.propagate = False
    logger.setLevel(logging.INFO if cluster.tracing else logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
        logger.setLevel(level)
