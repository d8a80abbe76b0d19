"""Floods addresses with datagrams and connections for some seconds, and writes to standard output what it has sent.

``scripts/bench flood`` runs this file in the pod of a stranger. So it imports nothing but Python's standard library. Its argument is the
number of seconds. Each line of its standard input is a plan as JSON (see :class:`Plan`), which replaces the one before. It ends by
itself after its seconds, or earlier if its standard input ends.

Datagrams leave in batches (sendmmsg(2)), as fast as the kernel takes them, half of them small and half of them large. Connections are made
again as soon as they have ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import itertools
import json
import mmap
import os
import resource
import select
import signal
import socket
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

BATCH = 64
"""Datagrams of one system call."""

SMALL, LARGE = 64, 1400
"""Bytes of a datagram that imitates nothing."""

HEADERS = 28
"""Bytes of the headers of IPv4 and UDP."""

SLOTS = 64
"""Connections that one process keeps open, or tries to, for each port and each manner."""

UNANSWERED = 1.0
"""Seconds after which an attempt to connect begins again."""

SLOW = 0.5
"""Seconds between two bytes of a slow connection."""

CLOCK_EVERY = 16
"""Attempts to connect after which the clock is read."""

PAGES = (b"/metrics", b"/ready", b"/alive", b"/tree", b"/status")

RTPS = b"RTPS\x02\x03\x01\x0f" + bytes(range(12))
"""The header of a message of DDS, from a participant that nobody knows."""


Targets = Sequence[tuple[str, int, str]]
"""Address, port, and what to send or how to connect."""


@dataclass
class Plan:
    """What to send."""

    udp: list[tuple[str, int, str]] = field(default_factory=list)
    """Address, port, and what the datagrams imitate: ``random``, ``rtps``, ``probe`` or ``unsigned:UID``."""
    tcp: list[tuple[str, int, str]] = field(default_factory=list)
    """Address, port, and the manner of the connections: ``syn``, ``silent``, ``garbage``, ``slow`` or ``pages``."""
    processes: int = 2
    """Processes that send datagrams. There are as many for connections, and one of those only begins connections."""


class Until:
    """The end of a plan: a moment, or earlier if another plan replaces it. Processes that are forked share it."""

    def __init__(self, end: float) -> None:
        """``end`` is in monotonic seconds."""
        self._end = end
        self._replaced = mmap.mmap(-1, 1)

    def replace(self) -> None:
        """End now."""
        self._replaced[0] = 1

    def over(self) -> bool:
        """Whether it has ended."""
        return self._replaced[0] == 1 or time.monotonic() >= self._end


Work = Callable[[Targets, Until], dict[str, float]]
"""Sends to targets until the plan ends, and returns what it has sent."""


# -- datagrams ---------------------------------------------------------------------------------------------------------


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    _fields_ = (("header", _Header), ("sent", ctypes.c_uint32))


def datagrams(what: str) -> list[bytes]:
    """Return the contents of the datagrams that imitate something. They are sent in turn."""
    kind, _, uid = what.partition(":")
    match kind:
        case "random":
            return [os.urandom(SMALL), os.urandom(LARGE)]
        case "rtps":
            return [RTPS + _data(SMALL), RTPS + _data(LARGE)]
        case "probe":
            # As kube/gates/probes.py makes them: magic, name of the key, number, MAC.
            return [b"USP2" + os.urandom(8) + (1 << 62).to_bytes(8, "big") + os.urandom(16) for _ in range(4)]
        case "unsigned":
            return [
                b"USP1" + uid.encode() + number.to_bytes(8, "big") + time.time_ns().to_bytes(8, "big")
                for number in (1, 2)
            ]
    raise ValueError(f"unknown datagram {what!r}")


def _data(size: int) -> bytes:
    """Return a DATA submessage for any reader, from a writer that nobody knows (RTPS 2.5, 9.4.5.4), with random contents."""
    body = (
        bytes(4) + b"\x00\x00\x00\x00" + b"\x00\x00\x12\x03" + bytes(4) + (1).to_bytes(4, "little") + os.urandom(size)
    )
    return b"\x15\x05" + len(body).to_bytes(2, "little") + body


class Datagrams:
    """Datagrams to one port, ready to be sent."""

    def __init__(self, host: str, port: int, what: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, port))
        contents = datagrams(what)
        self._buffers = [ctypes.create_string_buffer(one, len(one)) for one in contents]
        self._vectors = [_Vector(ctypes.addressof(one), len(one)) for one in self._buffers]
        self._messages = (_Message * BATCH)()
        for number, message in enumerate(self._messages):
            message.header.vectors = ctypes.pointer(self._vectors[number % len(contents)])
            message.header.count = 1
        self.mean = sum(map(len, contents)) / len(contents)
        """Mean size in bytes."""
        self.sent = 0

    def send(self, sendmmsg: Callable[..., int]) -> None:
        """Send one batch. An error, such as that nobody listens there, loses it."""
        self.sent += max(0, sendmmsg(self._socket.fileno(), self._messages, BATCH, 0))


def flood_datagrams(targets: Targets, until: Until) -> dict[str, float]:
    """Send datagrams to all targets in turn until the plan ends. Returns how many, by what they imitate, and the bytes."""
    sendmmsg = ctypes.CDLL(None, use_errno=True).sendmmsg
    found = [(what.partition(":")[0], Datagrams(host, port, what)) for host, port, what in targets]
    while not until.over():
        for _, one in found:
            one.send(sendmmsg)
    counts: Counter[str] = Counter()
    for kind, one in found:
        counts[f"datagrams {kind}"] += one.sent
    sent = sum(one.sent * (one.mean + HEADERS) for _, one in found)
    return {**counts, "datagrams": counts.total(), "bytes": sent}


# -- connections -------------------------------------------------------------------------------------------------------


def flood_syn(targets: Targets, until: Until) -> dict[str, float]:
    """Begin connections and give each up at once, until the plan ends. Returns how many were begun."""
    begun = 0
    addresses = itertools.cycle([(host, port) for host, port, _ in targets])
    while not until.over():
        for address in itertools.islice(addresses, CLOCK_EVERY):
            with socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as one:
                if one.connect_ex(address) in (0, errno.EINPROGRESS):
                    begun += 1
    return {"connections begun": begun}


@dataclass
class _Connection:
    address: tuple[str, int]
    manner: str
    socket: socket.socket
    begun: float
    established: bool = False


class Connections:
    """Connections to all targets, each replaced as soon as it has ended."""

    def __init__(self, pages: Iterator[bytes] | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self._poll = select.epoll()
        self._open: dict[int, _Connection] = {}
        self._garbage = os.urandom(512) + b"\n" + os.urandom(1024)
        self._pages = pages or itertools.cycle(PAGES)

    def add(self, address: tuple[str, int], manner: str) -> None:
        """Begin a connection."""
        one = socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        self.counts["connections begun"] += 1
        if one.connect_ex(address) not in (0, errno.EINPROGRESS):
            self.counts["connections refused"] += 1
        self._open[one.fileno()] = _Connection(address, manner, one, time.monotonic())
        self._poll.register(one.fileno(), select.EPOLLOUT)

    def run(self, until: Until) -> None:
        """Serve the connections until the plan ends."""
        ticked = time.monotonic()
        while not until.over():
            for number, events in self._poll.poll(0.1, 256):
                if (one := self._open.get(number)) is not None and not self._serve(one, events):
                    self._replace(one)
            if (now := time.monotonic()) - ticked >= SLOW:
                ticked = now
                self._tick(now)

    def _serve(self, one: _Connection, events: int) -> bool:
        """Go on with a connection. Returns False if it has ended."""
        if events & (select.EPOLLERR | select.EPOLLHUP):
            self.counts["connections refused"] += not one.established
            return False
        try:
            if not one.established:
                one.established = True
                self.counts["connections established"] += 1
                if one.manner == "pages":
                    one.socket.send(b"GET %s HTTP/1.1\r\nHost: robot\r\n\r\n" % next(self._pages))
                writes = one.manner == "garbage"
                self._poll.modify(one.socket.fileno(), select.EPOLLIN | (select.EPOLLOUT if writes else 0))
            if events & select.EPOLLIN and not one.socket.recv(65536):
                return False
            if events & select.EPOLLOUT and one.manner == "garbage":
                self.counts["bytes"] += one.socket.send(self._garbage)
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def _tick(self, now: float) -> None:
        for one in list(self._open.values()):
            if not one.established and now - one.begun > UNANSWERED:
                self.counts["connections unanswered"] += 1
                self._replace(one)
            elif one.established and one.manner == "slow":
                try:
                    one.socket.send(b"{")
                except BlockingIOError:
                    pass
                except OSError:
                    self._replace(one)

    def _replace(self, one: _Connection) -> None:
        del self._open[one.socket.fileno()]
        one.socket.close()
        self.add(one.address, one.manner)


def flood_connections(targets: Targets, until: Until) -> dict[str, float]:
    """Keep connections open to all targets until the plan ends. Returns how many were begun and established, and more."""
    connections = Connections()
    for host, port, manner in targets:
        for _ in range(SLOTS):
            connections.add((host, port), manner)
    connections.run(until)
    return dict(connections.counts)


# -- all of it ---------------------------------------------------------------------------------------------------------


class Generation:
    """The processes that carry out one plan."""

    def __init__(self, plan: Plan, until: Until) -> None:
        self._until = until
        syn = [one for one in plan.tcp if one[2] == "syn"]
        kept = [one for one in plan.tcp if one[2] != "syn"]
        parts: list[tuple[Work, Targets]] = [(flood_datagrams, plan.udp)] * plan.processes if plan.udp else []
        parts += [(flood_syn, syn)] if syn else []
        parts += [(flood_connections, kept)] * max(1, plan.processes - 1) if kept else []
        self._running = [self._start(work, targets) for work, targets in parts]

    def end(self) -> Counter[str]:
        """End the plan. Returns what was sent."""
        self._until.replace()
        found: Counter[str] = Counter()
        for process, output in self._running:
            with os.fdopen(output) as lines:
                found.update(json.loads(lines.read() or "{}"))
            os.waitpid(process, 0)
        return found

    def _start(self, work: Work, targets: Targets) -> tuple[int, int]:
        """Start a process. Returns its id, and the end of a pipe from which its result can be read."""
        output, own = os.pipe()
        if process := os.fork():
            os.close(own)
            return process, output
        try:
            set_death_signal = 1
            ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
            with os.fdopen(own, "w") as lines:
                json.dump(work(targets, self._until), lines)
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(0)


def flood(seconds: float, plans: int) -> dict[str, float]:
    """Carry out the plans that arrive at a file descriptor. Returns what was sent, and the seconds and processor seconds that it took."""
    begun = time.monotonic()
    found: Counter[str] = Counter()
    generation: Generation | None = None
    text = b""
    while (left := begun + seconds - time.monotonic()) > 0:
        if not select.select([plans], [], [], left)[0]:
            break
        if not (piece := os.read(plans, 65536)):
            break
        *lines, text = (text + piece).split(b"\n")
        for line in lines:
            before, generation = generation, Generation(Plan(**json.loads(line)), Until(begun + seconds))
            found += before.end() if before is not None else Counter()
    found += generation.end() if generation is not None else Counter()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {**found, "seconds": time.monotonic() - begun, "processor seconds": used.ru_utime + used.ru_stime}


def main(arguments: Sequence[str]) -> None:
    """Carry out the plans of the standard input for the seconds of the command line."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    print(json.dumps(flood(float(arguments[0]), sys.stdin.fileno())), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
