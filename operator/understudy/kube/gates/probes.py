"""Gate probes: small datagrams to the gated port range. Only those of the active instance get through.

They show the monitor since when a gate is enforced and whether policies are enforced at all. An API server's answer
does not show that. The agent sends them, because they must leave from the pod that the gate names.

A probe has a MAC under a key of the session in which the monitor requested it (api/protocol/session_keys.py), and a number. So nobody else
can make one, and one that arrives twice counts once. The key shows which pod sent it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import logging
import math
import socket
import struct
import threading
import time
from bisect import bisect_left
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.api.protocol import session_keys
from understudy.clock import CLOCK, ClockSteps
from understudy.kube.gates import probe_filter

_logger = logging.getLogger(__name__)

_SIGNED = struct.Struct("!4s8sQ16s")
_SIGNED_MAGIC = b"USP2"
_FORMAT = struct.Struct("!4s36sQQ")
_MAGIC = b"USP1"
_NANO = 1_000_000_000

PERIOD = 1.0
"""Seconds between probes at rest."""

SHORTEST_INTERVAL = 0.0005
LONGEST_BURST = 30.0
"""Longest burst in seconds, so that no request can overload an agent."""

COARSER = 0.05
"""Growth of a burst's interval, as a part of the time that the burst has lasted: times are measured to within five
percent."""

COARSEST = 10
"""Largest interval of a burst, in multiples of its first interval."""

REST = 0.02
"""Seconds between two reads of arrivals while no caller waits for one. The kernel notes when each probe arrived."""

_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_TIMESPEC = struct.Struct("qq")


@dataclass(frozen=True)
class Probe:
    """A datagram without a MAC, as agents of version 1 of the protocol and ``understudy doctor`` send it."""

    uid: str
    sequence: int
    sent: float
    """Unix seconds by the sender's clock."""


def encode(uid: str, sequence: int, sent_ns: int) -> bytes:
    """Return the datagram of a pod, without a MAC. Raises ValueError if the UID does not have 36 ASCII characters."""
    raw = uid.encode()
    if len(raw) != 36:
        raise ValueError(f"pod UID {uid!r} has {len(raw)} bytes, a Kubernetes UID has 36")
    return _FORMAT.pack(_MAGIC, raw, sequence, sent_ns)


def decode(datagram: bytes) -> Probe | None:
    """Return the probe in a datagram without a MAC; None if it contains none."""
    if len(datagram) != _FORMAT.size or not datagram.startswith(_MAGIC):
        return None
    _, uid, sequence, sent = _FORMAT.unpack(datagram)
    try:
        return Probe(uid.decode("ascii"), sequence, sent / _NANO)
    except UnicodeDecodeError:
        return None


def sign(key: bytes, sequence: int) -> bytes:
    """Return a datagram with a MAC."""
    unsigned = _SIGNED.pack(_SIGNED_MAGIC, _key_name(key), sequence, b"")[: -session_keys.TAG]
    return unsigned + session_keys.tag(key, unsigned)


def _key_name(key: bytes) -> bytes:
    """Return the name of a key in datagrams, from which nobody can calculate the key."""
    return hmac.digest(key, b"name", "sha256")[:8]


@dataclass
class _Key:
    uid: str
    key: bytes
    last: int = 0
    """Number of the newest datagram."""


class ProbeKeys:
    """The pods whose probes count, and what authenticates them."""

    SESSIONS = 8
    """Keys of one pod that count: an agent uses the key of the session in which it was last configured, which may not be the newest."""

    def __init__(self) -> None:
        self._pods: OrderedDict[str, deque[_Key]] = OrderedDict()
        self._named: dict[bytes, _Key] = {}
        self._unsigned: OrderedDict[str, None] = OrderedDict()

    def trust(self, uid: str, key: bytes) -> None:
        """Count the probes of a pod that have a MAC under this key."""
        self._unsigned.pop(uid, None)
        keys = self._pods.setdefault(uid, deque())
        self._pods.move_to_end(uid)
        if (name := _key_name(key)) not in self._named:
            self._named[name] = _Key(uid, key)
            keys.append(self._named[name])
        while len(keys) > self.SESSIONS:
            del self._named[_key_name(keys.popleft().key)]
        if len(self._pods) > Arrivals.PODS:
            for forgotten in self._pods.popitem(last=False)[1]:
                del self._named[_key_name(forgotten.key)]

    def trust_unsigned(self, uid: str) -> None:
        """Count the probes of a pod without a MAC, because its agent is too old to send others."""
        if uid not in self._pods:
            self._unsigned[uid] = None
            self._unsigned.move_to_end(uid)
            if len(self._unsigned) > Arrivals.PODS:
                self._unsigned.popitem(last=False)

    def knows(self, uid: str) -> bool:
        """Return whether probes of a pod count."""
        return uid in self._pods or uid in self._unsigned

    def filter(self) -> bytes:
        """Return the program with which a socket receives what could count, and nothing else."""
        forms = [probe_filter.Form(_SIGNED.size, _SIGNED_MAGIC, self._named)] if self._named else []
        forms += [probe_filter.Form(_FORMAT.size, _MAGIC)] if self._unsigned else []
        return probe_filter.program(forms)

    def sender(self, datagram: bytes) -> str | None:
        """Return the UID of the pod that has sent a probe; None if that is not certain, or if this probe or a later one came before."""
        if not datagram.startswith(_SIGNED_MAGIC):
            probe = decode(datagram)
            return probe.uid if probe is not None and probe.uid in self._unsigned else None
        if len(datagram) != _SIGNED.size:
            return None
        _, name, sequence, tag = _SIGNED.unpack(datagram)
        found = self._named.get(name)
        if found is None or sequence <= found.last:
            return None
        if not hmac.compare_digest(session_keys.tag(found.key, datagram[: -session_keys.TAG]), tag):
            return None
        found.last = sequence
        return found.uid


class ProbeSender:
    """Sends an instance's probes: one every second, and bursts on request.

    Bursts run in a thread of their own that sleeps until the next probe is due. An event loop's timers have a
    resolution of a millisecond, and are late if the loop is busy.
    """

    def __init__(self, uid: str) -> None:
        """``uid`` is that of the pod that sends. Raises ValueError as :func:`encode` does."""
        encode(uid, 0, 0)
        self._uid = uid
        self._sequence = 0
        self._sockets: dict[int, socket.socket] = {}
        self._lock = threading.Lock()
        self._target: tuple[str, int, bytes] | None = None
        """Host, port and key."""
        self._burst_begun = self._burst_until = 0.0  # monotonic seconds
        self._burst_interval = 0.001
        self._bursting = False
        self._stopped = threading.Event()
        self._timer: asyncio.TimerHandle | None = None

    def aim(self, host: str, port: int = names.PROBE_PORT, *, key: bytes = b"") -> None:
        """Send to this address from now on, with MACs under a key; without MACs if it is empty.

        Raises ValueError if it is not an IP address or the port is invalid.
        """
        ipaddress.ip_address(host)
        if not 0 < port < 65536:
            raise ValueError(f"port {port} is none: 1 to 65535")
        self._target = (host, port, key)

    def rest(self) -> None:
        """Send nothing until the next :meth:`aim`."""
        self._target = None

    def run(self) -> None:
        """Start the probes of every second in the running event loop."""
        self._send()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self.run)

    def burst(self, interval: float, duration: float) -> None:
        """Send a probe every ``interval`` seconds, later less often, for ``duration`` seconds.

        A burst in progress starts again. Sending uses processor time that the switch needs, so the rate falls if a
        switch takes long (COARSER).

        Raises ValueError if the values are out of bounds, and RuntimeError if there is no address to send to.
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
            # After a stall, continue at the same pace instead of sending the missed probes at once.
            due = max(due + interval, now)
            time.sleep(due - now)

    def _send(self) -> None:
        target = self._target
        if target is None:
            return
        host, port, key = target
        with self._lock:
            self._sequence += 1
            datagram = sign(key, self._sequence) if key else encode(self._uid, self._sequence, time.time_ns())
            if self._stopped.is_set():
                return
            # A closed gate may cause an error (EPERM, ECONNREFUSED). A full queue loses a probe.
            with contextlib.suppress(OSError):
                self._socket(host).sendto(datagram, (host, port))

    def _socket(self, host: str) -> socket.socket:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        if family not in self._sockets:
            self._sockets[family] = sock = socket.socket(family, socket.SOCK_DGRAM)
            sock.setblocking(False)
        return self._sockets[family]


class Arrivals:
    """When each pod's probes arrived, as far as that is remembered. Times are Unix seconds."""

    PODS = 256
    """Pods that are remembered. If there are more, the one that was silent for longest is forgotten."""

    MOST = 4096
    """Arrivals that are remembered for each pod: four seconds of a burst."""

    def __init__(self) -> None:
        self._arrivals: OrderedDict[str, deque[float]] = OrderedDict()

    def of(self, uid: str) -> Sequence[float]:
        """Return when a pod's probes arrived, in order."""
        return self._arrivals.get(uid, ())

    def heard_since(self, time: float) -> list[str]:
        """Return the pods whose last probe arrived at or after a time."""
        return [uid for uid, arrivals in self._arrivals.items() if arrivals and arrivals[-1] >= time]

    def add(self, uid: str, arrival: float) -> None:
        """Record that a pod's probe arrived."""
        arrivals = self._arrivals.get(uid)
        if arrivals is None:
            if len(self._arrivals) >= self.PODS:
                self._arrivals.popitem(last=False)
            arrivals = self._arrivals[uid] = deque(maxlen=self.MOST)
        else:
            self._arrivals.move_to_end(uid)
        # The kernel may stamp two probes out of order, or with a clock that was set meanwhile.
        arrivals.append(max(arrival, arrivals[-1]) if arrivals else arrival)

    def shift(self, step: float, now: float) -> None:
        """Move all times by ``step`` seconds, after the clock was set to ``now``."""
        for uid, arrivals in self._arrivals.items():
            # The kernel may have stamped the last one with the new clock already.
            self._arrivals[uid] = deque((min(arrival + step, now) for arrival in arrivals), maxlen=self.MOST)


class ProbeReceiver:
    """Records when each pod's probes arrive.

    The times are the kernel's timestamps, so that a busy process does not record them late.
    """

    leak_hint = (
        "The cluster's network does not enforce NetworkPolicies for UDP with endPort. Use a network plugin that does."
    )
    block_hint = "Check whether another NetworkPolicy selects the pod, or whether the network drops its UDP packets."

    def __init__(self, keys: ProbeKeys | None = None) -> None:
        """``keys`` authenticate the probes. Without them, the probes of all senders count that have no MAC, as in a test of the network."""
        self._keys = keys
        self._arrivals = Arrivals()
        self._steps = ClockSteps()
        self._taken = time.time()
        """When the socket was last read to its end."""
        self._socket: socket.socket | None = None
        self._filter = b""
        """The program of the socket's filter."""
        self._changed = asyncio.Event()
        self._waiting = 0
        self._resting: asyncio.TimerHandle | None = None

    async def listen(self, *, port: int = names.PROBE_PORT, host: str = "0.0.0.0") -> int:
        """Start to receive and return the port, which the kernel chooses if ``port`` is 0. Raises OSError."""
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
        self._renew_filter()
        self._start_reading()
        bound: int = sock.getsockname()[1]
        return bound

    def close(self) -> None:
        """Stop receiving."""
        if self._socket is not None:
            self._stop_reading()
            self._socket.close()
            self._socket = None

    def trust(self, uid: str, key: bytes) -> None:
        """Count the probes of a pod that have a MAC under this key."""
        if self._keys is not None:
            self._keys.trust(uid, key)
            self._renew_filter()

    def trust_unsigned(self, uid: str) -> None:
        """Count the probes of a pod without a MAC."""
        if self._keys is not None:
            self._keys.trust_unsigned(uid)
            self._renew_filter()

    def recognizes(self, uid: str) -> bool:
        """Return whether probes of a pod would count."""
        return self._keys is None or self._keys.knows(uid)

    def last(self, uid: str) -> float | None:
        """Return when a pod's last probe arrived, in Unix seconds; None if none did."""
        self._take()
        arrivals = self._arrivals.of(uid)
        return arrivals[-1] if arrivals else None

    def heard_since(self, time: float) -> Sequence[str]:
        """Return the UIDs of all pods of which a probe has arrived since a time (Unix seconds)."""
        self._take()
        return self._arrivals.heard_since(time)

    def count_since(self, uid: str, time: float) -> int:
        """Return the number of a pod's probes that arrived at or after a time, as far as they are remembered."""
        self._take()
        arrivals = self._arrivals.of(uid)
        return len(arrivals) - bisect_left(arrivals, time)

    def first_since(self, uid: str, time: float) -> float | None:
        """Return when the first probe of a pod at or after a time arrived."""
        self._take()
        arrivals = self._arrivals.of(uid)
        if not arrivals or arrivals[-1] < time:
            return None
        return arrivals[bisect_left(arrivals, time)]

    def deciding(self) -> None:
        """Nothing: packets show what passes, whatever was decided."""

    def committed(self, epoch: int) -> None:
        """Nothing, as in :meth:`deciding`."""

    def carried_out(self, epoch: int) -> int:
        """Return 0: packets do not carry epochs."""
        return 0

    def own_switch(self, active: str) -> None:
        """Return None, as in :meth:`switched`."""

    def is_back(self, active: str) -> bool:
        """Return False, as in :meth:`switched`."""
        return False

    def switched(self, active: str) -> None:
        """Return None: nobody switches at the far side of the gate but the robot's own readers."""

    @property
    def is_away(self) -> bool:
        """False: nobody reports."""
        return False

    def reported(self, active: str) -> None:
        """Return None: only packets show whom the gate lets through."""

    async def wait(self, uid: str, after: float, within: float | None = None) -> float:
        """Return when the first probe of a pod at or after a time arrived, waiting for one if necessary.

        Both times are of the process's clock. Raises TimeoutError if none arrived within ``within`` seconds.
        """
        self._waiting += 1
        self._start_reading()
        try:
            async with asyncio.timeout(within):
                while (first := self.first_since(uid, CLOCK.to_system(after))) is None:
                    await self._changed.wait()
        finally:
            self._waiting -= 1
        return CLOCK.of_system(first)

    def _renew_filter(self) -> None:
        """Let the kernel discard what cannot count, so that it takes no place in the buffer."""
        if self._keys is not None and self._socket is not None and self._filter != (code := self._keys.filter()):
            probe_filter.attach(self._socket, code)
            self._filter = code

    def _start_reading(self) -> None:
        """Let the event loop report arrivals from now on."""
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._socket is not None:
            asyncio.get_running_loop().add_reader(self._socket.fileno(), self._arrived)

    def _stop_reading(self) -> None:
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())

    def _arrived(self) -> None:
        """Read what has arrived.

        While no caller waits, delay the next read, so that a burst does not wake this process each time.
        """
        self._take()
        if not self._waiting:
            self._stop_reading()
            self._resting = asyncio.get_running_loop().call_later(REST, self._start_reading)
        self._changed.set()
        self._changed = asyncio.Event()

    def _take(self) -> None:
        """Record what has arrived, but use no more than a fair share of the event loop's time."""
        low, high = self._follow_clock()
        for _ in range(256):
            if self._socket is None:
                return
            try:
                datagram, ancillary, _flags, _address = self._socket.recvmsg(_FORMAT.size + 1, 64)
            except (BlockingIOError, InterruptedError):
                self._taken = time.time()
                break
            except OSError as error:
                _logger.warning("receiving probes: %s", error)
                break
            if (uid := self._sender(datagram)) is not None:
                self._arrivals.add(uid, min(max(_timestamp(ancillary), low), high))

    def _sender(self, datagram: bytes) -> str | None:
        if self._keys is not None:
            return self._keys.sender(datagram)
        probe = decode(datagram)
        return probe.uid if probe is not None else None

    def _follow_clock(self) -> tuple[float, float]:
        """Move the times of arrivals if the clock was set. Returns the bounds for those of probes that were not read yet.

        The kernel stamped them by the old clock. They arrived after the last read.
        """
        step = self._steps.taken()
        if not step:
            return -math.inf, math.inf
        now = time.time()
        self._arrivals.shift(step, now)
        self._taken += step
        return self._taken, now


def _timestamp(ancillary: list[tuple[int, int, bytes]]) -> float:
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return float(seconds + nanoseconds / _NANO)
    return time.time()
