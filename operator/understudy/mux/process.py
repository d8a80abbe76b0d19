"""The process of a mux: joins the robot's graph, follows the writers of the instances, and runs the forwarder until SIGTERM.

Another process starts it again if it crashes, because nothing reaches the robot meanwhile.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import secrets
import signal
import sys
import time
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from understudy.api import names
from understudy.api.protocol.mux_messages import derive, topics
from understudy.mux.control_journal import ControlJournal
from understudy.mux.forwarder import Forwarder
from understudy.mux.served_workloads import Served, served_workloads
from understudy.process import cpu_scheduling, json_logs
from understudy.process.file_replacement import replace_file
from understudy.process.restarts import end_with_parent, keep_running
from understudy.ros.rmw import MIDDLEWARE

if TYPE_CHECKING:
    from understudy.ros.actions.forwarded_outputs import Route
    from understudy.ros.actions.text_exchange import TextExchange
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph

_logger = logging.getLogger(__name__)

STATE = Path(names.STATE_DIR)

REPORT_PERIOD = 1.0
"""Seconds between two reports if nothing changes."""

NAMED_WITHIN = 25.0
"""Seconds after which a writer counts although its node has no name. Discovery reports names after writers, and reports the writers of a
process that was killed, such as a former mux, for 20 s and without a name."""


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT.

    UNDERSTUDY_NAMESPACE and UNDERSTUDY_WORKLOAD name the workload. UNDERSTUDY_OUTPUTS has its outputs, and UNDERSTUDY_ALLOWED_NODES the
    nodes that may write them beside the mux, as in its spec, as JSON. UNDERSTUDY_TOKEN_FILE is the file with its token. Without
    UNDERSTUDY_WORKLOAD, each folder of UNDERSTUDY_MUX_FOLDER is of one workload: it has a file for each of these variables, and ``token``.
    UNDERSTUDY_STATE is the folder for whom it forwards, and UNDERSTUDY_ADDRESS this host's address, each with a default. The environment
    gives the ROS graph.
    """
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    state = Path(os.environ.get(names.MUX_STATE_VARIABLE, STATE))
    try:
        served = served_workloads(os.environ, state)
    except (KeyError, ValueError, OSError) as error:
        print(
            "understudy mux: it needs the environment of ConfigMap WORKLOAD-mux, and the token of Secret WORKLOAD-mux in the file "
            f"{names.MUX_TOKEN_FILE}, or in that of {names.MUX_TOKEN_VARIABLE}. For several workloads, it needs a folder with both for "
            f"each in {names.MUX_FOLDER}, or in that of {names.MUX_FOLDER_VARIABLE}: {error!r}",
            file=sys.stderr,
        )
        return 2
    for one in served:
        one.control.parent.mkdir(parents=True, exist_ok=True)
    cpu_scheduling.ask_for_short_slices()
    settings = state / "profiles.xml"
    settings.write_text(MIDDLEWARE.mux_settings([output for one in served for output in one.outputs]))
    os.environ[MIDDLEWARE.settings_variable] = str(settings)
    # Each process that is started has these modules.
    import understudy.ros.actions.forwarded_outputs
    import understudy.ros.actions.text_exchange
    import understudy.ros.observe.writer_instances  # noqa: F401

    return keep_running(lambda: asyncio.run(_run(served, state)))


@dataclass(frozen=True)
class _Side:
    """What the process does for one workload."""

    served: Served
    routes: Sequence[Route]
    forwarder: Forwarder
    work: _Work


async def _run(served: Sequence[Served], state: Path) -> None:
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph

    end_with_parent()
    loop, stopping = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopping.set)
    graph, wakeups = Graph("_".join(["understudy_mux", *(names.in_ros(one.name) for one in served)])), ArrivalWakeups()
    identity = _identity(state)
    sides = _sides(served, identity, graph, wakeups)

    def arrived() -> None:
        wakeups.clear()
        for side in sides:
            side.work.done()

    loop.add_reader(wakeups.descriptor, arrived)
    tasks = [asyncio.create_task(_follow(sides, state / "writers.json", arrived))]
    tasks += [asyncio.create_task(side.work.run()) for side in sides]
    stopped = asyncio.create_task(stopping.wait())
    await asyncio.wait([*tasks, stopped], return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        if task.done():
            task.result()
        task.cancel()
    loop.remove_reader(wakeups.descriptor)
    _logger.info("ended")


def _sides(served: Sequence[Served], identity: str, graph: Graph, wakeups: ArrivalWakeups) -> list[_Side]:
    """Return what is done for each workload that can be served. Raises what the last one raises if none can."""
    from understudy.ros.runtime.graph_node import NotReceivable
    from understudy.ros.runtime.interface_types import TypeNotInstalled

    found: list[_Side] = []
    for number, one in enumerate(served, 1):
        try:
            found.append(_side(one, identity, graph, wakeups))
        except (ValueError, TypeNotInstalled, NotReceivable) as error:
            if number == len(served) and not found:
                raise
            _logger.error("nothing of %s/%s is forwarded: %s", one.namespace, one.name, error)
    return found


def _side(served: Served, identity: str, graph: Graph, wakeups: ArrivalWakeups) -> _Side:
    from understudy.ros.actions.forwarded_outputs import routes
    from understudy.ros.actions.text_exchange import TextExchange
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups

    ways, keys = routes(served.outputs, graph, wakeups), derive(served.token, served.namespace, served.name)
    forwarder = Forwarder(ways, keys, ControlJournal(served.control), identity)
    orders, reports = topics(served.namespace, served.name)
    exchange = TextExchange(graph, ArrivalWakeups(), reads=orders, writes=reports)
    _logger.info("mux of %s/%s: %s", served.namespace, served.name, ", ".join(output.name for output in served.outputs))
    return _Side(served, ways, forwarder, _Work(forwarder, exchange))


def _identity(state: Path) -> str:
    """Return what orders call this mux, the same after each start."""
    path = state / "identity"
    with contextlib.suppress(FileNotFoundError):
        if found := path.read_text():
            return found
    path.write_text(found := secrets.token_hex(8))
    return found


class _Work:
    """What is done when something arrives, and when a silence is long enough."""

    def __init__(self, forwarder: Forwarder, exchange: TextExchange) -> None:
        self._forwarder, self._exchange = forwarder, exchange
        self._timer: asyncio.TimerHandle | None = None
        self._wake = asyncio.Event()

    def order(self, text: str) -> None:
        """Carry out an order."""
        self._forwarder.order(text)
        self.done()

    def done(self) -> None:
        """Do what is due now, and again when a silence may be long enough."""
        forwarder = self._forwarder
        forwarder.drain()
        if forwarder.changed:
            self._wake.set()
        due = forwarder.due_at
        if self._timer is not None and due < self._timer.when():
            self._timer.cancel()
            self._timer = None
        if self._timer is None and math.isfinite(due):
            # The loop's clock is the forwarder's. A sample that arrives meanwhile only makes the timer look too early once.
            self._timer = asyncio.get_running_loop().call_at(due, self._due)

    def _due(self) -> None:
        self._timer = None
        self.done()

    async def run(self) -> None:
        """Receive orders, and publish reports, until cancelled."""
        with self._exchange.receiving(self.order):
            await self.report()

    async def report(self) -> None:
        """Publish a report at once after a change, and once a second."""
        while True:
            self._exchange.publish(self._forwarder.report())
            self._wake.clear()
            try:
                async with asyncio.timeout(REPORT_PERIOD):
                    await self._wake.wait()
            except TimeoutError:
                self.done()


async def _follow(sides: Sequence[_Side], memory: Path, learned: Callable[[], None]) -> None:
    """Learn whose writers there are, and match the QoS of both sides. ``learned`` is called when discovery has reported new writers.

    ``memory`` is a file with the writers of instances: a writer never becomes that
    of another instance, so a process that starts again need not wait for what discovery answers.
    """
    from understudy.ros.observe.writer_instances import WriterInstances

    found, since = WriterInstances(os.environ.get(names.ADDRESS_VARIABLE, "")), dict[bytes, float]()
    known = ChainMap(found.names, _remembered(memory))
    for side in sides:
        side.forwarder.instances = known

    def remember() -> None:
        learned()
        try:
            replace_file(memory, json.dumps({gid.hex(): name for gid, name in found.names.items() if name}))
        except OSError as error:  # a full disk is no reason to forward nobody
            _logger.warning("%s cannot be written, so a mux that starts again has to ask discovery: %s", memory, error)

    await found.follow(
        lambda: tuple(route.counts() for side in sides for route in side.routes),
        lambda: _look(sides, known, since, time.monotonic()),
        remember,
    )


def _remembered(memory: Path) -> dict[bytes, str]:
    """Return the writers of instances that the former process knew."""
    try:
        found = TypeAdapter(dict[str, str]).validate_json(memory.read_bytes())
        return {bytes.fromhex(gid): name for gid, name in found.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        _logger.warning("%s cannot be read, so discovery is asked for all writers: %r", memory, error)
        return {}


def _look(sides: Sequence[_Side], instances: Mapping[bytes, str], since: dict[bytes, float], now: float) -> set[bytes]:
    """Match the QoS of both sides, and note who writes beside the mux. Returns the writers that are present.

    ``since`` is kept for the next look: when each writer was found.
    """
    present = set[bytes]().union(*(_look_at(side, instances, since, now) for side in sides))
    for gone in since.keys() - present:
        del since[gone]
    return present


def _look_at(side: _Side, instances: Mapping[bytes, str], since: dict[bytes, float], now: float) -> set[bytes]:
    present: set[bytes] = set()
    strangers: set[str] = set()
    for route in side.routes:
        writers = route.writers()
        present |= {end.gid for end in writers}
        since |= {end.gid: since.get(end.gid, now) for end in writers}
        # None: discovery has not reported it yet.
        ours = {end.gid: instances.get(end.gid) for end in writers}
        strangers |= {
            f"{route.output} by {end.node or 'an unnamed node'}"
            for end in writers
            if ours[end.gid] == ""
            and (end.node or now - since[end.gid] >= NAMED_WITHIN)
            and end.node not in side.served.allowed
        }
        route.follow([gid for gid, instance in ours.items() if instance])
    side.forwarder.strangers = tuple(sorted(strangers))
    return present
