"""Freezes the application of an isolated pod until the monitor decides about it. permit.py decides, this module acts.

TCP connections show whether somebody can be reached: an accepted and a refused connection are both answers. The kernel gives
them, so that a busy process does not delay them.
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
from understudy.agent.held_containers import make_fifo, wake_fifo
from understudy.agent.permit import Permit
from understudy.api import names
from understudy.api.protocol import agent_messages, freeze_script
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)

ANSWER = 1.0
"""Seconds after which an answer no longer counts: it describes the time at which it was sent."""

MOST_WITNESSES = 8

APISERVER_PERIOD = 1.0
"""Seconds between two questions to the API server while no monitor is connected."""

LOG_PERIOD = 10.0
"""Seconds between two log lines about an error that every evaluation has."""

_AT_ONCE = struct.pack("ii", 1, 0)  # SO_LINGER: close leaves no state behind


@dataclass(frozen=True)
class Address:
    """The address of a party that may answer."""

    host: str
    port: int
    accept: bool = False
    """Whether only an accepted connection counts: the node itself refuses the address of a Service that has no pods."""


class MonitorSessions(Protocol):
    """The sessions with monitors, as far as they show that a monitor is reachable."""

    @property
    def count(self) -> int:
        """The number of sessions."""

    def delivered(self) -> bool:
        """Return whether the other side of a session has received everything that was sent."""

    def abort(self) -> None:
        """End all sessions at once."""


class Isolation:
    """Freezes the containers of one pod while it is isolated; idle if none of them can be frozen."""

    def __init__(
        self,
        directory: Path,
        containers: Sequence[str],
        *,
        unfenced: Sequence[str] = (),
        apiserver: Address | None = None,
        on_change: Callable[[], None] = lambda: None,
        nudge: Callable[[], None] = lambda: None,
        attempts: Callable[[], ConnectionAttempts] | None = None,
    ) -> None:
        """``on_change`` is called when the containers are frozen or continue, ``nudge`` to send something in every session.

        ``attempts`` makes the connections that show whether somebody answers.
        """
        self.containers = tuple(containers)
        self._unfenced = tuple(unfenced)
        self._directory, self._on_change, self._nudge = directory, on_change, nudge
        self._apiserver = apiserver
        self.monitor: Address | None = None
        """The monitor that renewed the permit last; None if none did."""
        self._witnesses: tuple[Address, ...] = ()
        self._favourite: Address | None = None
        self._make_attempts = attempts or ConnectionAttempts
        self._attempts = self._make_attempts()
        self._asked_apiserver = 0.0
        self._logged_at = -LOG_PERIOD
        self.contacts: MonitorSessions | None = None
        self.since: float | None = None
        """Since when the containers are frozen, in Unix seconds; None while they run."""
        self.permit = Permit()
        """The permit to act."""
        self._applied = self.permit.state
        with contextlib.suppress(OSError):
            self.since = self._marker.stat().st_mtime
            self.permit = Permit(state="Isolated")

    @property
    def _marker(self) -> Path:
        return self._directory / freeze_script.HELD_NAME

    @property
    def reason(self) -> str:
        """Why the application is frozen; empty while it runs."""
        if self.since is None:
            return ""
        since = datetime.fromtimestamp(self.since, UTC).strftime("%H:%M:%S UTC")
        match self.permit.state:
            case "Isolated":
                return f"frozen since {since}, because nobody answers the agent"
            case "Replaced":
                return f"frozen since {since}, because nobody answered the agent; another instance has replaced it"
            case _:
                return f"frozen since {since}, because nobody answered the agent; it waits for the monitor's decision"

    @property
    def unfenced(self) -> str:
        """Why the application could not be frozen if it were isolated; empty if it could, or need not be."""
        if self._unfenced:
            return f"container {', '.join(self._unfenced)} has no command in the template"
        if self.containers and self.permit.state == "Idle":
            return "neither the monitor nor another pod has answered the agent yet"
        return ""

    def build(self, containers: Sequence[str]) -> None:
        """Create the FIFOs that freeze containers, before their applications start. Raises OSError."""
        for container in containers:
            make_fifo(self._directory / freeze_script.fence_name(container))
        self.containers = tuple(containers)

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that a monitor can request."""
        return {agent_messages.RENEW_PERMIT: self.renew}

    async def renew(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Take the addresses of the parties that may answer, and the monitor's decision about a frozen application.

        Raises Refused.
        """
        found, word = body.get("witnesses", []), body.get("word")
        if not isinstance(found, list) or not all(isinstance(host, str) for host in found):
            raise Refused(f"witnesses: expected a list of addresses, not {found!r:.100}")
        if word not in ("Go", "Stay", None):
            raise Refused(f"word {word!r:.100}: expected Go or Stay")
        self.monitor = self._favourite = Address(peer.host, names.PROBE_PORT)
        self._witnesses = tuple(Address(host, names.PROBE_PORT) for host in found[:MOST_WITNESSES])
        if word is not None:
            self.permit.instruct(word, time.monotonic())
            self._apply()

    async def run(self) -> None:
        """Evaluate until cancelled."""
        try:
            while True:
                if self.containers:
                    self._evaluate_safely(time.monotonic())
                await asyncio.sleep(self.permit.wait)
        finally:
            self._attempts.close()

    def _evaluate_safely(self, now: float) -> None:
        """Evaluate, whatever error occurs: nothing else would freeze an isolated application.

        A restarted agent could not either, because it does not know that anybody has ever answered.
        """
        for evaluate in (self._evaluate, self._evaluate_without_answers):
            try:
                evaluate(now)
                return
            except Exception:
                if now - self._logged_at >= LOG_PERIOD:
                    self._logged_at = now
                    _logger.exception("cannot evaluate whether anybody answers")

    def _evaluate_without_answers(self, now: float) -> None:
        """Evaluate as if nobody answered, because nobody can be asked."""
        self._attempts.close()
        self._attempts = self._make_attempts()
        self.permit.evaluate(now)
        if self.permit.asked_at != now:
            self.permit.ask(now)
        self._apply()

    def _evaluate(self, now: float) -> None:
        permit, contacts = self.permit, self.contacts
        self._take_answers(now)
        if permit.rounds and permit.state != "Idle" and contacts is not None and contacts.delivered():
            permit.answered(now)
        permit.evaluate(now)
        self._apply()
        match permit.ask(now):
            case "One":
                self._ask(now, self._favourite)
            case "Everybody":
                if permit.state != "Idle":
                    self._nudge()
                self._ask(now, self.monitor, *self._witnesses)
                # The API server logs its connections, so it is asked only if nobody else answers.
                if permit.rounds > 1 and permit.state != "Idle":
                    self._ask(now, self._apiserver)
        if permit.state == "Reconnected" and not (contacts and contacts.count):
            if now - self._asked_apiserver >= APISERVER_PERIOD:
                self._asked_apiserver = now
                self._ask(now, self._apiserver)
        else:
            permit.apiserver(now, False)

    def _apply(self) -> None:
        """Apply the state of the permit."""
        state, before = self.permit.state, self._applied
        self._applied = state
        if (before, state) == ("Isolated", "Reconnected") and self.contacts is not None:
            # TCP repeats unacknowledged data only after seconds; a monitor whose session ends connects again at once.
            self.contacts.abort()
        if self.permit.frozen != (self.since is not None):
            try:
                self._mark(self.permit.frozen)
            except OSError as error:
                _logger.error("%s: could not freeze the application or let it continue: %s", self._marker, error)
        if state != before:
            if before != "Idle":
                _logger.warning("%s", self.reason or "the application continues")
            self._on_change()

    def _mark(self, frozen: bool) -> None:
        if frozen:
            replace_file(self._marker, "", mode=0o644)
            self.since = time.time()
        else:
            self._marker.unlink(missing_ok=True)
            self.since = None
        for container in self.containers:
            if not wake_fifo(self._directory / freeze_script.fence_name(container)):
                _logger.warning(
                    "nothing in container %s reads its FIFO, so it was not %s",
                    container,
                    "frozen" if frozen else "continued",
                )

    def _ask(self, now: float, *addresses: Address | None) -> None:
        for address in addresses:
            if address is not None:
                self._attempts.ask(address, now)

    def _take_answers(self, now: float) -> None:
        for address, asked_at, answer in self._attempts.answers(now):
            if address == self._apiserver:
                self.permit.apiserver(now, answer)
            if answer and address in (self.monitor, *self._witnesses, self._apiserver):
                self._favourite = address
                self.permit.answered(asked_at)


class ConnectionAttempts:
    """TCP connections that only show whether an address answers. Nothing is awaited: the caller asks for the results later."""

    def __init__(self) -> None:
        self._open: list[tuple[Address, float, socket.socket]] = []
        self._ended: list[tuple[Address, float, bool]] = []

    def ask(self, address: Address, now: float) -> None:
        """Begin to connect to an address."""
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
        """Return the attempts that ended since the last call: the address, when it was asked, and whether it answered."""
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
        """Cancel all attempts."""
        for _, _, sock in self._open:
            sock.close()
        self._open = []


def _is_answer(address: Address, error: int) -> bool:
    return not error or (error == errno.ECONNREFUSED and not address.accept)


def built(directory: Path, containers: Sequence[str]) -> tuple[str, ...]:
    """Return the containers that an earlier agent of this pod made freezable."""
    return tuple(container for container in containers if (directory / freeze_script.fence_name(container)).exists())


def apiserver(environment: Mapping[str, str]) -> Address | None:
    """Return the API server's address from a pod's environment; None if it is not an IP address and a port."""
    host, port = environment.get("KUBERNETES_SERVICE_HOST", ""), environment.get("KUBERNETES_SERVICE_PORT", "")
    try:
        socket.getaddrinfo(host, port, flags=socket.AI_NUMERICHOST | socket.AI_NUMERICSERV)
    except (OSError, UnicodeError):
        return None
    return Address(host, int(port), accept=True) if host and port.isdigit() else None
