"""Connections between processes, below asyncio's streams: the real clients and servers of the project run over them.

While a path is interrupted, nothing is lost: it is delivered once the path is back, as TCP repeats it. A side that gets no
acknowledgement for long ends the connection, and the other side does not learn of that while the path is interrupted.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

from tests.unit.interleavings.scheduling import Process, VirtualLoop, current

UNACKNOWLEDGED = 6.0
"""Seconds without an acknowledgement after which a side ends the connection."""


class Socket:
    """The options of a side's socket."""

    def __init__(self) -> None:
        self.discards = False
        """Whether what was not delivered is discarded when the connection ends."""

    def setsockopt(self, _: int, option: int, value: object) -> None:
        self.discards = self.discards or (option, value) == (socket.SO_LINGER, struct.pack("ii", 1, 0))

    def fileno(self) -> int:
        return -1


class Side(asyncio.Transport):
    """One side of a connection."""

    def __init__(self, tcp: Tcp, process: Process, host: str, path: tuple[Process, str]) -> None:
        """``host`` is the address of the other side; ``path`` is the client, and the address of the server."""
        self._socket = Socket()
        super().__init__({"peername": (host, 0), "socket": self._socket})
        self._tcp, self.process, self.path = tcp, process, path
        self.protocol: asyncio.Protocol | None = None
        self.other: Side | None = None
        self._unsent: list[bytes | None] = []
        """What waits for the path; None is the end of the connection."""
        self._arrives = 0.0
        self.closed = False

    def connect(self, other: Side, protocol: asyncio.Protocol) -> None:
        """Begin. Is called in this side's process."""
        self.other, self.protocol = other, protocol
        protocol.connection_made(self)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send bytes."""
        if not self.is_closing():
            self._send(bytes(data))

    def _send(self, data: bytes | None) -> None:
        if self._unsent or not self._tcp.open(*self.path):
            if not self._unsent:
                self._tcp.later(UNACKNOWLEDGED, self._unacknowledged)
            self._unsent.append(data)
            self._tcp.waiting.add(self)
            return
        now = self._tcp.loop.time()
        self._arrives = max(self._arrives, now + self._tcp.delay())
        assert self.other is not None
        self._tcp.later(self._arrives - now, self.other.arrive, data)

    def resume(self) -> None:
        """Send what has waited for the path."""
        unsent, self._unsent = self._unsent, []
        for data in unsent:
            self._send(data)

    def _unacknowledged(self) -> None:
        if self._unsent and not self._tcp.open(*self.path):
            self._lost(TimeoutError("not acknowledged"))

    def arrive(self, data: bytes | None) -> None:
        """Receive bytes, or that the other side has ended."""
        if data is None:
            self._lost(None)
        elif not self.closed and self.process.alive:
            assert self.protocol is not None
            self._soon(self.protocol.data_received, data)

    def _lost(self, error: Exception | None) -> None:
        if self.closed:
            return
        self.closed = True
        self._tcp.forget(self)
        assert self.protocol is not None
        self._soon(self.protocol.connection_lost, error)

    def _soon(self, work: Callable[..., object], *args: Any) -> None:
        if self.process.alive:
            self._tcp.loop.call_soon(work, *args, context=self.process.context)

    def end(self) -> None:
        """End the connection; the other side receives everything that was sent before."""
        if not self.closed:
            self._send(None)
            self._lost(None)

    def close(self) -> None:
        if self.process.alive:
            self.end()

    def abort(self) -> None:
        if self._socket.discards and not self.is_closing():
            self._unsent.clear()
            if self._tcp.open(*self.path):  # nobody repeats a reset that is lost
                self._send(None)
            self._lost(None)
        self.close()

    def is_closing(self) -> bool:
        return self.closed or not self.process.alive

    def get_write_buffer_size(self) -> int:
        return sum(len(data or b"") for data in self._unsent)

    def pause_reading(self) -> None:
        return

    def resume_reading(self) -> None:
        return


@dataclass
class Listener:
    """A server's end."""

    process: Process
    factory: Callable[[], asyncio.Protocol]
    sockets: tuple[()] = ()
    """There are none: connections do not wait here until they are accepted."""

    def close(self) -> None:
        return


class Tcp:
    """All connections."""

    def __init__(self, loop: VirtualLoop, world: Process, delay: Callable[[], float]) -> None:
        self.loop, self.delay, self._world = loop, delay, world
        self.open: Callable[[Process, str], bool] = lambda process, host: True
        """Whether packets pass between a client and the address of a server."""
        self._listeners: dict[str, Listener] = {}
        self._sides: dict[Process, dict[Side, None]] = {}
        self.waiting: set[Side] = set()
        loop.tcp = self

    def later(self, seconds: float, work: Callable[..., object], *args: Any) -> None:
        """Do something in the network after so many seconds."""
        self.loop.call_later(seconds, work, *args, context=self._world.context)

    def forget(self, side: Side) -> None:
        """Forget a side that has ended. What it sent still arrives."""
        self._sides.get(side.process, {}).pop(side, None)

    def changed(self) -> None:
        """Paths may be open again."""
        waiting, self.waiting = sorted(self.waiting, key=lambda side: (side.path[1], side.process.name)), set()
        for side in waiting:
            side.resume()

    def ended(self, process: Process) -> None:
        """A process has ended, and its kernel closes its connections."""
        for side in list(self._sides.pop(process, {})):
            side.end()

    async def serve(self, factory: Callable[[], asyncio.Protocol], host: str) -> Listener:
        """Listen on an address."""
        process = current()
        assert process is not None
        self._listeners[host] = Listener(process, factory)
        return self._listeners[host]

    async def connect(self, factory: Callable[[], asyncio.Protocol], host: str) -> tuple[Side, asyncio.Protocol]:
        """Connect to an address. Waits forever if nothing answers. Raises ConnectionRefusedError."""
        client = current()
        assert client is not None
        await asyncio.sleep(2 * self.delay())
        if not self.open(client, host):
            await self.loop.create_future()
        listener = self._listeners.get(host)
        if listener is None or not listener.process.alive:
            raise ConnectionRefusedError
        path = (client, host)
        near, far = Side(self, client, host, path), Side(self, listener.process, client.name, path)
        for side in (near, far):
            self._sides.setdefault(side.process, {})[side] = None
        self.loop.call_soon(far.connect, near, listener.factory(), context=listener.process.context)
        protocol = factory()
        near.connect(far, protocol)
        return near, protocol


def of(loop: VirtualLoop) -> Tcp:
    """The connections in a loop's world."""
    return cast(Tcp, loop.tcp)
