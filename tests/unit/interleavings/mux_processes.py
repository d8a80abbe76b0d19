"""The mux of one robot as a process that can be killed: its real code over modelled topics, routes and a modelled disk.

Its folder outlives it. Samples arrive one by one, and wait while the process stands still.
"""

from __future__ import annotations

import asyncio
import base64
import functools
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from tests.unit.interleavings.gates import NAMESPACE
from tests.unit.interleavings.mux_topics import MuxExchange, Topics
from tests.unit.interleavings.network import Network
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.scenes import ON_BOARD
from tests.unit.interleavings.scheduling import Killed, Process, current
from tests.unit.interleavings.senses import TOPIC
from understudy.api import names
from understudy.api.protocol.mux_messages import Token, derive
from understudy.mux.control import Control
from understudy.mux.control_journal import ControlJournal
from understudy.mux.forwarder import Forwarder
from understudy.mux.process import _Work

DEPTH = 100
"""Samples that wait for a process that stands still, as in the product."""

DISCOVERED = (0.02, 0.5)
"""Least and most seconds until a mux has discovered whose a writer is."""

SECRET_AGAIN = 0.2
"""Seconds between two looks whether the token exists."""


@dataclass(frozen=True)
class Sample:
    """A command of an instance, as it arrived at the mux."""

    uid: str
    """``ON_BOARD`` for the instance on board."""
    writer: bytes
    number: int
    """Grows with each arrival at this mux."""


class Witness(Protocol):
    """Learns what muxes do."""

    def loaded(self, mux: Mux, control: Control, *, is_journal_lost: bool) -> None:
        """A mux has started."""

    def received(self, mux: Mux, text: str) -> None:
        """A mux has carried an order out, or has refused it."""

    def decided(self, mux: Mux, before: Control, after: Control) -> None:
        """The control of a mux has changed."""

    def forwarded(self, mux: Mux, token: Token, sample: Sample) -> None:
        """A robot receives a command."""


class Disk:
    """The volume of a mux."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self.is_full = False
        """Whether nothing can be synced."""
        self.kills_in: int | None = None
        """After how many more syncs its process is killed."""

    @property
    def file(self) -> Path:
        """The journal."""
        return self.folder / "control.json"


class WatchedForwarder(Forwarder):
    """The real one, whose decisions a witness learns."""

    mux: Mux

    def _apply(self, control: Control, now: float) -> None:
        before = self.control
        super()._apply(control, now)
        self.mux.decided(before, self.control)

    def order(self, text: str) -> None:
        super().order(text)
        self.mux.witness.received(self.mux, text)


class Route:
    """The only output. Implements :class:`understudy.mux.forwarder.Route`."""

    output = TOPIC

    def __init__(self, forward: Callable[[Sample], None], command: Callable[[], None]) -> None:
        self.queue: deque[Sample] = deque(maxlen=DEPTH)
        self._forward, self._command = forward, command

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Take what has arrived, and forward what is accepted."""
        forwarded = 0
        while self.queue:
            sample = self.queue.popleft()
            if forwards(sample.writer):
                self._forward(sample)
                forwarded += 1
        return forwarded

    def forget(self) -> None:
        """Nothing is held."""

    def command(self, values: Mapping[str, Any]) -> None:
        """Send a safe command."""
        self._command()


class Mux:
    """The mux of a workload, over all its processes."""

    def __init__(self, network: Network, world: Process, workload: str, topics: Topics, disk: Disk) -> None:
        self._network, self._world = network, world
        self.workload, self.topics, self.disk = workload, topics, disk
        self.witness: Witness
        self.changed: Callable[[], None] = lambda: None
        """Called when it may forward somebody else."""
        self.commanded: Callable[[], None] = lambda: None
        """Called when it sends the robot a safe command."""
        self.process: Process | None = None
        self.forwarder: WatchedForwarder | None = None
        self.began = 0.0
        """When the present process started (virtual seconds)."""
        self.arrivals = 0
        """Number of samples that have arrived."""
        self._heard: set[bytes] = set()
        self.last: dict[str, float] = {}
        """When a sample of an instance, given by its name, last arrived at the present process (virtual seconds)."""
        self.last_known: dict[str, float] = {}
        """The same, of writers that it had discovered by then."""
        self.taken: dict[str, float] = {}
        """When the present process last took a sample of an instance: later than it arrived, if the process had no processor."""
        self._known: dict[bytes, str] = {}
        self._ready: set[str] = set()
        """What has arrived for a process that has not looked yet."""
        self._is_lost = False

    @property
    def control(self) -> Control | None:
        """The control of the present process; None if there is none, or if it has just begun."""
        return self.forwarder.control if self.forwarder is not None else None

    def runs(self) -> bool:
        """Whether its process can do something now."""
        return self.process is not None and self.process.alive and not self.process.stalled

    @property
    def refuses(self) -> str:
        """Why it refused the last order; empty if it did not."""
        return self.forwarder._refused if self.forwarder is not None else ""

    @property
    def is_hindered(self) -> bool:
        """Whether something keeps it from carrying out orders."""
        return not self.runs() or self.forwarder is None or self.disk.is_full

    def forwards(self, found: Running) -> bool:
        """Whether it forwards what an instance sends."""
        control = self.control
        is_known = writer_of(found) in self._known
        return self.runs() and is_known and control is not None and control.source == found.name

    # -- its process ------------------------------------------------------------------------------------------------

    def start(self, name: str, follow: Callable[[Process, Any], None]) -> None:
        """A process of it starts."""
        loop = self._network.loop
        process = self.process = loop.process(name)
        self.began = loop.time()
        self.last, self.last_known, self.taken, self._known, self._heard, self._ready = {}, {}, {}, {}, set(), set()
        follow(process, self._run(process))

    def end(self) -> None:
        """Its process is killed."""
        if self.process is not None:
            self.process.kill()
        self.process = self.forwarder = self.topics.mux = None
        self.changed()

    def lose_journal(self) -> None:
        """Its volume is lost, between two processes."""
        self.disk.file.unlink(missing_ok=True)
        self._is_lost = True

    async def _run(self, process: Process) -> None:
        """As ``understudy.mux.process`` puts it together."""
        token = await self._token()
        route = Route(self._forward, lambda: self.commanded())
        keys = derive(token, NAMESPACE, self.workload)
        made = WatchedForwarder([route], keys, ControlJournal(self.disk.file), clock=self._network.loop.clock)
        made.mux, made.instances = self, self._known
        self.forwarder, self._route = made, route
        is_lost, self._is_lost = self._is_lost, False
        self.witness.loaded(self, made.control, is_journal_lost=is_lost)
        self._exchange = MuxExchange(self.topics, process, functools.partial(self._wake, "orders"))
        self._work = _Work(made, cast(Any, self._exchange))
        self.changed()
        await self._work.report()

    async def _token(self) -> bytes:
        place = (NAMESPACE, names.mux(self.workload))
        while (secret := self._network.server.get("secrets", place)) is None:
            await asyncio.sleep(SECRET_AGAIN)
        return base64.b64decode(secret["data"][names.TOKEN])

    # -- what arrives, and what it does -----------------------------------------------------------------------------

    def arrive(self, found: Running) -> None:
        """A sample of an instance arrives."""
        self._arrive(found.name, found.uid, writer_of(found))

    def arrive_from_on_board(self) -> None:
        """A sample of the instance on board arrives."""
        self._arrive(ON_BOARD, ON_BOARD, ON_BOARD.encode())

    def _arrive(self, name: str, uid: str, writer: bytes) -> None:
        process, choices = self.process, self._network.choices
        if process is None or not process.alive or self.forwarder is None:
            return
        if writer not in self._heard:
            least, most = DISCOVERED
            within = least + (most - least) * choices.random()
            self._network.later(within, self._discover, writer, name, process=process)
        self._heard.add(writer)
        self.last[name] = self._network.loop.time()
        if writer in self._known:
            self.last_known[name] = self._network.loop.time()
        self.arrivals += 1
        self._route.queue.append(Sample(uid, writer, self.arrivals))
        self._wake("samples")

    def _wake(self, ready: str) -> None:
        process = self.process
        if process is not None and process.alive:
            if not self._ready:
                self._network.loop.call_soon(self._look, context=process.context)
            self._ready.add(ready)

    def _look(self) -> None:
        """Read what has arrived. Nothing promises which of two descriptors is read first."""
        ready, self._ready = sorted(self._ready), set()
        if len(ready) > 1 and self._network.choices.random() < 0.5:
            ready.reverse()
        for one in ready:
            if one == "samples":
                self.taken |= {
                    self._known[sample.writer]: self._network.loop.time()
                    for sample in self._route.queue
                    if sample.writer in self._known
                }
                self._work.done()
                continue
            for text in self._exchange.received():
                self._work.order(text)

    def _discover(self, writer: bytes, name: str) -> None:
        self._known[writer] = name
        self._work.done()
        self._soon()

    def _forward(self, sample: Sample) -> None:
        assert self.forwarder is not None
        self.witness.forwarded(self, self.forwarder.control.token, sample)

    def decided(self, before: Control, after: Control) -> None:
        """Its control has changed."""
        self.witness.decided(self, before, after)
        if before.source != after.source:
            self._soon()

    def _soon(self) -> None:
        self._network.later(0.0, self.changed)


def writer_of(found: Running) -> bytes:
    """The writer of the present process of an instance."""
    return f"{found.uid}/{found.restarts}".encode()


def sync(disks: Callable[[Process], tuple[Disk, Callable[[], None]] | None], fail: Callable[[], bool]) -> Any:
    """Stands in for ``os.fsync``. ``disks`` returns the disk of a process, and what kills that; ``fail`` whether a sync fails."""

    def fsync(descriptor: int) -> None:
        process = current()
        found = disks(process) if process is not None else None
        if found is None:
            return
        disk, kill = found
        if disk.kills_in is not None:
            disk.kills_in -= 1
            if disk.kills_in < 0:
                disk.kills_in = None
                kill()
                raise Killed
        if disk.is_full and fail():
            raise OSError(28, "No space left on device")

    return fsync
