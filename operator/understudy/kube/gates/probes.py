"""Gate probes: small datagrams into the gated port range that only the instance in control gets through.

The monitor sees from them, not from an API server's answer, since when a gate is enforced and whether policies are
enforced at all. The agent sends them, since what it sends leaves from the pod that the gate names.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import socket
import struct
import threading
import time
from bisect import bisect_left
from collections import OrderedDict, deque
from dataclasses import dataclass

from understudy.api import names

_logger = logging.getLogger(__name__)

_FORMAT = struct.Struct("!4s36sQQ")
_MAGIC = b"USP1"
_NANO = 1_000_000_000

PERIOD = 1.0
"""Seconds between probes at rest."""

SHORTEST_INTERVAL = 0.0005
LONGEST_BURST = 30.0
"""Bounds of a burst in seconds, so that no request makes an agent a burden."""

COARSER = 0.05
"""How much coarser a burst gets, of the time that it has lasted: what it's asked to see is seen within five percent."""

COARSEST = 10
"""Times its first interval that a burst's intervals get at most."""

REST = 0.02
"""Seconds between two looks for arrivals while nobody waits for one: the kernel notes when each came."""

_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_TIMESPEC = struct.Struct("qq")


@dataclass(frozen=True)
class Probe:
    """One datagram."""

    uid: str
    sequence: int
    sent: float
    """Unix seconds of the sender's clock."""


def encode(uid: str, sequence: int, sent_ns: int) -> bytes:
    """The datagram of a pod. Raises ValueError when the UID isn't 36 ASCII characters."""
    raw = uid.encode()
    if len(raw) != 36:
        raise ValueError(f"pod UID {uid!r} has {len(raw)} bytes, a Kubernetes UID has 36")
    return _FORMAT.pack(_MAGIC, raw, sequence, sent_ns)


def decode(datagram: bytes) -> Probe | None:
    """The probe in a datagram, None when it holds none."""
    if len(datagram) != _FORMAT.size or not datagram.startswith(_MAGIC):
        return None
    _, uid, sequence, sent = _FORMAT.unpack(datagram)
    try:
        return Probe(uid.decode("ascii"), sequence, sent / _NANO)
    except UnicodeDecodeError:
        return None


class ProbeSender:
    """Sends an instance's probes: one a second, and bursts when asked.

    Bursts run in a thread of their own that sleeps until each one is due: an event loop's timers are a millisecond
    coarse and late when it is busy.
    """

    def __init__(self, uid: str) -> None:
        """``uid`` of the pod that sends. Raises ValueError as :func:`encode` does."""
        encode(uid, 0, 0)
        self._uid = uid
        self._sequence = 0
        self._sockets: dict[int, socket.socket] = {}
        self._lock = threading.Lock()
        self._target: tuple[str, int] | None = None
        self._burst_begun = self._burst_until = 0.0  # monotonic seconds
        self._burst_interval = 0.001
        self._bursting = False
        self._stopped = threading.Event()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def target(self) -> tuple[str, int] | None:
        """Address and port probes go to; None while no monitor is known."""
        return self._target

    def aim(self, host: str, port: int = names.PROBE_PORT) -> None:
        """Send to this address from now on. Raises ValueError when it is no IP address or no port."""
        ipaddress.ip_address(host)
        if not 0 < port < 65536:
            raise ValueError(f"port {port} is none: 1 to 65535")
        self._target = (host, port)

    def rest(self) -> None:
        """Send nothing until aimed again."""
        self._target = None

    def run(self) -> None:
        """Start the probe of every second in the running event loop."""
        self._send()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self.run)

    def burst(self, interval: float, duration: float) -> None:
        """Send one every ``interval`` seconds, later less often, for ``duration`` seconds; one under way begins anew.

        Sending takes from the processors that the switch needs, so the rate falls as a switch takes long (COARSER).

        Raises ValueError when they are out of bounds, RuntimeError when it isn't aimed.
        """
        if not SHORTEST_INTERVAL <= interval <= 1.0:
            raise ValueError(f"interval {interval} s is out of bounds: {SHORTEST_INTERVAL} to 1 s")
        if not 0 < duration <= LONGEST_BURST:
            raise ValueError(f"duration {duration} s is out of bounds: above 0, at most {LONGEST_BURST} s")
        if self._target is None:
            raise RuntimeError("no address to send probes to is known")
        with self._lock:
            self._burst_interval, self._burst_begun = interval, time.monotonic()
            self._burst_until = max(self._burst_until, self._burst_begun + duration)
            if self._bursting:
                return
            self._bursting = True
        threading.Thread(target=self._run_burst, name="probes", daemon=True).start()

    def close(self) -> None:
        """Stop sending."""
        self._stopped.set()
        if self._timer is not None:
            self._timer.cancel()
        with self._lock:
            for sock in self._sockets.values():
                sock.close()
            self._sockets.clear()

    def _run_burst(self) -> None:
        due = time.monotonic()
        while not self._stopped.is_set():
            with self._lock:
                if due >= self._burst_until:
                    self._bursting = False
                    return
                interval = self._burst_interval
                interval = min(max(interval, COARSER * (due - self._burst_begun)), COARSEST * interval)
            self._send()
            now = time.monotonic()
            # After a stall, go on at the pace instead of making up for it in a flood.
            due = max(due + interval, now)
            time.sleep(due - now)

    def _send(self) -> None:
        target = self._target
        if target is None:
            return
        with self._lock:
            self._sequence += 1
            datagram = encode(self._uid, self._sequence, time.time_ns())
            if self._stopped.is_set():
                return
            # A closed gate may be told as an error (EPERM, ECONNREFUSED); a full queue loses a probe.
            with contextlib.suppress(OSError):
                self._socket(target[0]).sendto(datagram, target)

    def _socket(self, host: str) -> socket.socket:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        if family not in self._sockets:
            self._sockets[family] = sock = socket.socket(family, socket.SOCK_DGRAM)
            sock.setblocking(False)
        return self._sockets[family]


class ProbeReceiver:
    """Notes when probes of which pods arrive, by the kernel's timestamp, so that a busy process sees them no later."""

    PODS = 256
    """Pods remembered; beyond, the one not heard of for longest is forgotten."""

    ARRIVALS = 4096
    """Arrivals remembered for each pod: four seconds of a burst."""

    leak_hint = (
        "The cluster's network does not enforce NetworkPolicies for UDP with endPort. Use a network plugin that does."
    )
    block_hint = "Look for other NetworkPolicies that select it, or for a network that does not carry its traffic."

    def __init__(self) -> None:
        self._arrivals: OrderedDict[str, deque[float]] = OrderedDict()
        self._socket: socket.socket | None = None
        self._changed = asyncio.Event()
        self._waiting = 0
        self._resting: asyncio.TimerHandle | None = None

    async def listen(self, *, port: int = names.PROBE_PORT, host: str = "0.0.0.0") -> int:
        """Receive from now on; the port, which is the kernel's choice where 0 is given. Raises OSError."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            sock.bind((host, port))
        except OSError:
            sock.close()
            raise
        self._socket = sock
        self._look()
        bound: int = sock.getsockname()[1]
        return bound

    def close(self) -> None:
        """Receive no more."""
        if self._socket is not None:
            self._look_away()
            self._socket.close()
            self._socket = None

    def pods(self) -> list[str]:
        """UIDs of the pods that a probe came from."""
        self._take()
        return list(self._arrivals)

    def last(self, uid: str) -> float | None:
        """When a pod's last probe arrived, in Unix seconds; None when none did."""
        self._take()
        arrivals = self._arrivals.get(uid)
        return arrivals[-1] if arrivals else None

    def count_since(self, uid: str, time: float) -> int:
        """Probes of a pod that arrived at or after a time, as far as they are remembered."""
        self._take()
        arrivals = self._arrivals.get(uid, ())
        return len(arrivals) - bisect_left(arrivals, time)

    def first_since(self, uid: str, time: float) -> float | None:
        """When the first probe of a pod at or after a time arrived."""
        self._take()
        arrivals = self._arrivals.get(uid)
        if not arrivals or arrivals[-1] < time:
            return None
        return arrivals[bisect_left(arrivals, time)]

    async def wait(self, uid: str, after: float, within: float | None = None) -> float:
        """When the first probe of a pod at or after a time arrived, waiting for one.

        Raises TimeoutError when none came within ``within`` seconds.
        """
        self._waiting += 1
        self._look()
        try:
            async with asyncio.timeout(within):
                while (first := self.first_since(uid, after)) is None:
                    await self._changed.wait()
        finally:
            self._waiting -= 1
        return first

    def _look(self) -> None:
        """Be told of arrivals from now on."""
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._socket is not None:
            asyncio.get_running_loop().add_reader(self._socket.fileno(), self._arrived)

    def _look_away(self) -> None:
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())

    def _arrived(self) -> None:
        """Take what is there. While nobody waits, what comes next has time: a burst isn't to wake this process each time."""
        self._take()
        if not self._waiting:
            self._look_away()
            self._resting = asyncio.get_running_loop().call_later(REST, self._look)
        self._changed.set()
        self._changed = asyncio.Event()

    def _take(self) -> None:
        """Note what has arrived, but not more than a fair share of the event loop's time."""
        for _ in range(256):
            if self._socket is None:
                return
            try:
                datagram, ancillary, _flags, _address = self._socket.recvmsg(_FORMAT.size + 1, 64)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                _logger.warning("receiving probes: %s", error)
                break
            probe = decode(datagram)
            if probe is not None:
                self._note(probe.uid, _timestamp(ancillary))

    def _note(self, uid: str, arrival: float) -> None:
        arrivals = self._arrivals.get(uid)
        if arrivals is None:
            if len(self._arrivals) >= self.PODS:
                self._arrivals.popitem(last=False)
            arrivals = self._arrivals[uid] = deque(maxlen=self.ARRIVALS)
        else:
            self._arrivals.move_to_end(uid)
        if arrivals and arrivals[-1] > arrival:
            # The clock went back: slewed a little, or set.
            if arrivals[-1] - arrival > 1.0:
                arrivals.clear()
            else:
                arrival = arrivals[-1]
        arrivals.append(arrival)


def _timestamp(ancillary: list[tuple[int, int, bytes]]) -> float:
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return float(seconds + nanoseconds / _NANO)
    return time.time()
