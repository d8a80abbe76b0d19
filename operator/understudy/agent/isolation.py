"""Holds the application of a pod that is cut off, until the monitor says what becomes of it (permit.py decides, this acts).

That somebody can be reached is found out by TCP connections: that one is accepted or refused is an answer, and either is
the kernel's alone, so that no answer comes late because a process is busy.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import select
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from understudy.agent.control_channel import Operation, Peer, Refused
from understudy.agent.held_containers import make_fifo, wake_fifo, write_atomically
from understudy.agent.permit import Permit
from understudy.api import names
from understudy.api.protocol import freeze_script

_logger = logging.getLogger(__name__)

ANSWER = 1.0
"""Seconds after which an answer doesn't count any more: it may take a while to get here, but says how it was when it left."""

MOST_WITNESSES = 8

APISERVER_PERIOD = 1.0
"""Seconds between two questions to the API server while no monitor is there."""

COMPLAIN = 10.0
"""Seconds between two words in the log about an error that comes with each look."""

_AT_ONCE = struct.pack("ii", 1, 0)  # SO_LINGER: a connection that was only to be answered leaves nothing behind


@dataclass(frozen=True)
class Address:
    """Who may answer."""

    host: str
    port: int
    accept: bool = False
    """Whether a refusal doesn't count: the address of a Service that has no pods is refused by the node itself."""


class MonitorSessions(Protocol):
    """The sessions with monitors, as far as they show that somebody is there."""

    @property
    def count(self) -> int:
        """How many there are."""

    def taken_in(self) -> bool:
        """Whether the other side of one has all that was sent to it."""

    def abort(self) -> None:
        """End all of them at once."""


class Isolation:
    """The applications of one pod; idle where none of its containers can be held."""

    def __init__(
        self,
        directory: Path,
        containers: Sequence[str],
        *,
        unfenced: Sequence[str] = (),
        apiserver: Address | None = None,
        on_change: Callable[[], None] = lambda: None,
        nudge: Callable[[], None] = lambda: None,
    ) -> None:
        """``on_change`` is called when they are held or let go, ``nudge`` to have something sent in every session."""
        self.containers = tuple(containers)
        self._unfenced = tuple(unfenced)
        self._directory, self._on_change, self._nudge = directory, on_change, nudge
        self._apiserver = apiserver
        self._monitor: Address | None = None
        self._witnesses: tuple[Address, ...] = ()
        self._favourite: Address | None = None
        self._attempts = ConnectionAttempts()
        self._asked_apiserver = 0.0
        self._complained_at = -COMPLAIN
        self.contacts: MonitorSessions | None = None
        self.since: float | None = None
        """Since when they are held, in unix seconds."""
        self._permit = Permit()
        self._told = self._permit.state
        with contextlib.suppress(OSError):
            self.since = self._marker.stat().st_mtime
            self._permit = Permit(state="Away")

    @property
    def _marker(self) -> Path:
        return self._directory / freeze_script.HELD_NAME

    @property
    def reason(self) -> str:
        """Why the application is held; empty while it isn't."""
        if self.since is None:
            return ""
        since = datetime.fromtimestamp(self.since, UTC).strftime("%H:%M:%S UTC")
        match self._permit.state:
            case "Away":
                return f"held: cut off since {since}, nobody answers"
            case "Replaced":
                return f"held: it was cut off at {since} and was replaced"
            case _:
                return f"held: it was cut off at {since} and waits for the monitor's word"

    @property
    def unfenced(self) -> str:
        """Why the application couldn't be held if it were cut off; empty where it could, or needn't."""
        if self._unfenced:
            return f"container {', '.join(self._unfenced)} has no command in the template"
        if self.containers and self._permit.state == "Idle":
            return "nobody has answered its agent yet"
        return ""

    def build(self, containers: Sequence[str]) -> None:
        """Make what containers can be held by, before their applications are started. Raises OSError."""
        for container in containers:
            make_fifo(self._directory / freeze_script.fence_name(container))
        self.containers = tuple(containers)

    def operations(self) -> Mapping[str, Operation]:
        """What a monitor can ask for."""
        return {"lease": self.renew}

    async def renew(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Take the addresses of who may answer, and what becomes of the application if it is held. Raises Refused."""
        found, word = body.get("witnesses", []), body.get("word")
        if not isinstance(found, list) or not all(isinstance(host, str) for host in found):
            raise Refused(f"witnesses: expected a list of addresses, not {found!r:.100}")
        if word not in ("Go", "Stay", None):
            raise Refused(f"word {word!r:.100}: expected Go or Stay")
        self._monitor = self._favourite = Address(peer.host, names.PROBE_PORT)
        self._witnesses = tuple(Address(host, names.PROBE_PORT) for host in found[:MOST_WITNESSES])
        if word is not None:
            self._permit.word(word, time.monotonic())
            self._apply()

    async def run(self) -> None:
        """Watch until cancelled."""
        try:
            while True:
                if self.containers:
                    self._look_anyhow(time.monotonic())
                await asyncio.sleep(self._permit.wait)
        finally:
            self._attempts.close()

    def _look_anyhow(self, now: float) -> None:
        """Look, whatever error comes of it: nobody else does, and what is cut off would drive on. A restarted agent has forgotten
        that anybody ever answered, and would hold nothing either.
        """
        for look in (self._look, self._judge):
            try:
                look(now)
                return
            except Exception:
                if now - self._complained_at >= COMPLAIN:
                    self._complained_at = now
                    _logger.exception("looking whether anybody answers")

    def _judge(self, now: float) -> None:
        """Where nobody can be asked, it is as if nobody answered."""
        self._attempts.close()
        self._attempts = ConnectionAttempts()
        self._permit.look(now)
        if self._permit.asked_at != now:
            self._permit.ask(now)
        self._apply()

    def _look(self, now: float) -> None:
        permit, contacts = self._permit, self.contacts
        self._take_answers(now)
        if permit.rounds and permit.state != "Idle" and contacts is not None and contacts.taken_in():
            permit.answered(now)
        permit.look(now)
        self._apply()
        match permit.ask(now):
            case "One":
                self._ask(now, self._favourite)
            case "Everybody":
                if permit.state != "Idle":
                    self._nudge()
                self._ask(now, self._monitor, *self._witnesses)
                # Its connections are written down there, so it is asked only where nobody else is left.
                if permit.rounds > 1 and permit.state != "Idle":
                    self._ask(now, self._apiserver)
        if permit.state == "Back" and not (contacts and contacts.count):
            if now - self._asked_apiserver >= APISERVER_PERIOD:
                self._asked_apiserver = now
                self._ask(now, self._apiserver)
        else:
            permit.apiserver(now, False)

    def _apply(self) -> None:
        """Have what was decided come about."""
        state, before = self._permit.state, self._told
        self._told = state
        if (before, state) == ("Away", "Back") and self.contacts is not None:
            # What was sent meanwhile is repeated after seconds only; a monitor whose session ends comes back at once.
            self.contacts.abort()
        if self._permit.held != (self.since is not None):
            try:
                self._mark(self._permit.held)
            except OSError as error:
                _logger.error("%s: the application can't be held or let go: %s", self._marker, error)
        if state != before:
            if before != "Idle":
                _logger.warning("%s", self.reason or "the application goes on")
            self._on_change()

    def _mark(self, held: bool) -> None:
        if held:
            write_atomically(self._marker, "", 0o644)
            self.since = time.time()
        else:
            self._marker.unlink(missing_ok=True)
            self.since = None
        for container in self.containers:
            if not wake_fifo(self._directory / freeze_script.fence_name(container)):
                _logger.warning("container %s isn't there to be %s", container, "held" if held else "let go")

    def _ask(self, now: float, *addresses: Address | None) -> None:
        for address in addresses:
            if address is not None:
                self._attempts.ask(address, now)

    def _take_answers(self, now: float) -> None:
        for address, asked_at, answer in self._attempts.answers(now):
            if address == self._apiserver:
                self._permit.apiserver(now, answer)
            if answer and address in (self._monitor, *self._witnesses, self._apiserver):
                self._favourite = address
                self._permit.answered(asked_at)


class ConnectionAttempts:
    """Connections that are begun only to see whether anybody answers. Who asks looks again later: nothing is awaited."""

    def __init__(self) -> None:
        self._open: list[tuple[Address, float, socket.socket]] = []
        self._ended: list[tuple[Address, float, bool]] = []

    def ask(self, address: Address, now: float) -> None:
        """Begin to connect."""
        sock = None
        try:
            sock = socket.socket(socket.AF_INET6 if ":" in address.host else socket.AF_INET, socket.SOCK_STREAM)
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            error = sock.connect_ex((address.host, address.port))
        except OSError as problem:
            error = problem.errno or errno.EIO
        except (TypeError, ValueError):  # no address, and no name that could be looked up either
            error = errno.EINVAL
        if error == errno.EINPROGRESS and sock is not None:
            self._open.append((address, now, sock))
            return
        if sock is not None:
            sock.close()
        self._ended.append((address, now, _is_answer(address, error)))

    def answers(self, now: float) -> list[tuple[Address, float, bool]]:
        """What became of those that have ended since the last look: whom, when it was asked, and whether it answered."""
        found, self._ended = self._ended, []
        poll = select.poll()
        for _, _, sock in self._open:
            poll.register(sock, select.POLLOUT)
        done = {descriptor for descriptor, _ in poll.poll(0)}
        left = []
        for address, asked_at, sock in self._open:
            if sock.fileno() in done:
                error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                found.append((address, asked_at, _is_answer(address, error)))
            elif now - asked_at < ANSWER:
                left.append((address, asked_at, sock))
                continue
            else:
                found.append((address, asked_at, False))
            sock.close()
        self._open = left
        return found

    def close(self) -> None:
        """Give them all up."""
        for _, _, sock in self._open:
            sock.close()
        self._open = []


def _is_answer(address: Address, error: int) -> bool:
    return not error or (error == errno.ECONNREFUSED and not address.accept)


def built(directory: Path, containers: Sequence[str]) -> tuple[str, ...]:
    """Those of the containers that can be held since an earlier agent of this pod."""
    return tuple(container for container in containers if (directory / freeze_script.fence_name(container)).exists())


def apiserver(environment: Mapping[str, str]) -> Address | None:
    """The API server's address, which every pod is told. None where that isn't an IP address and a port."""
    host, port = environment.get("KUBERNETES_SERVICE_HOST", ""), environment.get("KUBERNETES_SERVICE_PORT", "")
    try:
        socket.getaddrinfo(host, port, flags=socket.AI_NUMERICHOST | socket.AI_NUMERICSERV)
    except (OSError, UnicodeError):
        return None
    return Address(host, int(port), accept=True) if host and port.isdigit() else None
