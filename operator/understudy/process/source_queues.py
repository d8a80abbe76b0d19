"""Queues of connections that nobody has accepted yet, one for each part of the addresses from which they come.

A socket that listens has one queue, and the kernel refuses whoever comes while it is full. Several sockets at one port have a queue each.
A program in the kernel chooses the queue by the address of the source, so that a flood from one address, however fast, fills one queue
only (Linux, socket(7), SO_REUSEPORT). It needs no privilege.

From each queue, few connections a second are accepted. So a flood costs little processor time, and nobody waits who is in another queue.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable

from understudy.kernel_programs import EQUAL, GO, LOAD_WORD, attach, instruction

_logger = logging.getLogger(__name__)

QUEUES = 16

BACKLOG = 32
"""Connections that wait in one queue, and those that are accepted from it at once after a rest."""

PACE = 0.02
"""Seconds between two connections that are accepted from one queue, on average."""

UNABLE = 1.0
"""Seconds until another attempt after the kernel could not provide a connection."""

_SO_ATTACH_REUSEPORT_CBPF = getattr(socket, "SO_ATTACH_REUSEPORT_CBPF", 51)
_BYTE, _SHIFT, _REMAINDER, _RETURN = 0x30, 0x74, 0x94, 0x16
"""Codes of instructions: load a byte, shift right, divide and keep the remainder, return the result."""

_NETWORK = 0xFFF00000
"""Offset of the header of IP (SKF_NET_OFF of linux/filter.h)."""

_SOURCE = 12
_SOURCE_6 = 20
"""Offsets of an IPv4 source, and of the last four bytes of an IPv6 source, in the header of IP."""

_PROGRAM = b"".join(
    (
        instruction(_BYTE, _NETWORK),
        instruction(_SHIFT, 4),
        instruction(EQUAL, 4, 0, 2),
        instruction(LOAD_WORD, _NETWORK + _SOURCE),
        instruction(GO, 1),
        instruction(LOAD_WORD, _NETWORK + _SOURCE_6),
        instruction(_REMAINDER, QUEUES),
        instruction(_RETURN),
    )
)
"""Returns the number of the queue: the address, or its last four bytes, modulo the number of queues."""


def beside(first: socket.socket) -> list[socket.socket]:
    """Return bound sockets for the further queues of a port, beside one that is bound to it and does not listen yet.

    There are none if the kernel allows none.
    """
    with contextlib.ExitStack() as opened:
        found = []
        try:
            # Not before it is bound: two processes that have the same port by mistake must notice it.
            first.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            for _ in range(QUEUES - 1):
                one = opened.enter_context(socket.socket(first.family, socket.SOCK_STREAM))
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
                if first.family == socket.AF_INET6:
                    one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                one.bind(first.getsockname())
                found.append(one)
        except OSError as error:
            _logger.info("a port has one queue for all addresses: %s", error)
            return []
        opened.pop_all()
        return found


def divide(first: socket.socket) -> None:
    """Let the kernel choose among the sockets at a port, which all listen, by the source of a connection."""
    try:
        attach(first, _SO_ATTACH_REUSEPORT_CBPF, _PROGRAM)
    except OSError as error:
        _logger.info("the queues of a port are not divided by address: %s", error)


class Server:
    """Accepts connections from all queues of a port."""

    def __init__(self, protocol: Callable[[], asyncio.Protocol], bound: asyncio.Server) -> None:
        """``bound`` has sockets that do not listen yet, one for each family of addresses."""
        self._protocol, self._bound = protocol, bound
        firsts = [sock.dup() for sock in bound.sockets]
        self.sockets = [*firsts, *(one for sock in firsts for one in beside(sock))]
        """The first one tells the port."""
        for sock in self.sockets:
            sock.setblocking(False)
            sock.listen(BACKLOG)
        for sock in firsts:
            divide(sock)
        self._accepting = [asyncio.create_task(self._accept(sock)) for sock in self.sockets]

    def close(self) -> None:
        """Accept no further connections."""
        for task in self._accepting:
            task.cancel()
        for sock in self.sockets:
            sock.close()
        self._bound.close()

    async def _accept(self, sock: socket.socket) -> None:
        """Accept connections, at the pace of one queue."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            try:
                connection, _ = await loop.sock_accept(sock)
            except OSError as error:  # such as that no descriptor is left
                _logger.warning("accepting a connection: %s", error)
                await asyncio.sleep(UNABLE)
                continue
            with contextlib.suppress(OSError):
                await loop.connect_accepted_socket(self._protocol, connection)
            # A queue that was empty for a while may be emptied at once.
            now = loop.time()
            due = max(due + PACE, now - BACKLOG * PACE)
            if due > now:
                await asyncio.sleep(due - now)
