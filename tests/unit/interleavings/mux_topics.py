"""The two topics on which monitors and the mux of a robot exchange texts, and the links between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from tests.unit.interleavings.network import Network
from tests.unit.interleavings.scheduling import Process

DEPTH = 10
"""Texts that are kept for a reader that does not take them, or that cannot be reached: the depth of the product's topics."""

REPEATED = 0.5
"""How often a writer repeats what it kept once a link is back. It does not if the reader was given up meanwhile."""


@dataclass(eq=False)
class Reader:
    """One side's subscription."""

    process: Process
    arrived: Callable[[], None]
    """Called in the process once texts have arrived."""
    texts: deque[str] = field(default_factory=lambda: deque(maxlen=DEPTH))
    _is_woken: bool = False

    def put(self, text: str, network: Network) -> None:
        """Let a text arrive."""
        self.texts.append(text)
        if self.process.alive and not self._is_woken:
            self._is_woken = True
            network.loop.call_soon(self._wake, context=self.process.context)

    def _wake(self) -> None:
        self._is_woken = False
        self.arrived()

    def received(self) -> Iterator[str]:
        """Yield the texts that arrived since the last call."""
        while self.texts:
            yield self.texts.popleft()


class MuxReader(Reader):
    """A mux's, which waits for samples too."""

    def put(self, text: str, network: Network) -> None:
        self.texts.append(text)
        self.arrived()


class Topics:
    """The topics of one robot. The texts of one writer arrive at a reader in their order."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self.mux: Reader | None = None
        self.monitors: dict[Process, Reader] = {}
        self.parted: set[Process] = set()
        """Monitors that exchange nothing with the mux."""
        self.loss = 0.0
        """How often a text is lost."""
        self.ordered: Callable[[str], None] = lambda text: None
        """Called with each order that is sent."""
        self.sent: deque[str] = deque(maxlen=50)
        """The last orders, as somebody may have recorded them."""
        self._kept: dict[tuple[Process, bool], deque[str]] = {}
        self._arrives: dict[tuple[Process, bool], float] = {}

    def order(self, monitor: Process, text: str) -> None:
        """A monitor publishes an order."""
        self.ordered(text)
        self.sent.append(text)
        self._send(monitor, text, is_order=True)

    def report(self, text: str) -> None:
        """The mux publishes a report."""
        for monitor in list(self.monitors):
            if monitor.alive:
                self._send(monitor, text, is_order=False)

    def repeat(self, text: str) -> None:
        """Somebody sends a recorded order again."""
        if self.mux is not None:
            self.mux.put(text, self._network)

    def _send(self, monitor: Process, text: str, *, is_order: bool) -> None:
        key, network = (monitor, is_order), self._network
        if monitor in self.parted:
            self._kept.setdefault(key, deque(maxlen=DEPTH)).append(text)
            return
        if network.choices.random() < self.loss:
            return
        now = network.loop.time()
        self._arrives[key] = max(self._arrives.get(key, 0.0), now + network.link_delay())
        network.later(self._arrives[key] - now, self._arrive, monitor, text, is_order)

    def _arrive(self, monitor: Process, text: str, is_order: bool) -> None:
        reader = self.mux if is_order else self.monitors.get(monitor)
        if reader is not None and reader.process.alive:
            reader.put(text, self._network)

    def part(self, monitor: Process) -> None:
        """A monitor and the mux do not reach each other any more."""
        self.parted.add(monitor)

    def join(self, monitor: Process) -> None:
        """They reach each other again. What was kept may be repeated."""
        self.parted.discard(monitor)
        for is_order in (True, False):
            kept = self._kept.pop((monitor, is_order), deque())
            if self._network.choices.random() < REPEATED:
                for text in kept:
                    self._send(monitor, text, is_order=is_order)


class MonitorExchange:
    """Stands in for :class:`understudy.ros.actions.text_exchange.TextExchange` in a monitor."""

    def __init__(self, topics: Topics, process: Process) -> None:
        self._topics, self._process = topics, process

    def publish(self, text: str) -> None:
        """Send a text to the mux."""
        self._topics.order(self._process, text)

    @contextmanager
    def receiving(self, receive: Callable[[str], None]) -> Iterator[None]:
        """Call a function with each text of the mux as it arrives, until the context ends."""

        def arrived() -> None:
            for text in reader.received():
                receive(text)

        reader = self._topics.monitors[self._process] = Reader(self._process, arrived)
        try:
            yield
        finally:
            self._topics.monitors.pop(self._process, None)


class MuxExchange:
    """The same in a mux."""

    def __init__(self, topics: Topics, process: Process, ready: Callable[[], None]) -> None:
        """``ready`` is called whenever a text arrives."""
        self._topics = topics
        self._reader = topics.mux = MuxReader(process, ready)

    def received(self) -> Iterator[str]:
        """Yield the texts that arrived since the last call."""
        return self._reader.received()

    def publish(self, text: str) -> None:
        """Send a text to all monitors."""
        self._topics.report(text)
