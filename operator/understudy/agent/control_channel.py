"""The control channel: authenticates monitors, carries out their requests, and reports the instance's state.

Nothing from the network is trusted before its message authentication code (MAC) is verified (api/protocol/secure_channel.py). An error in
a session ends only that session.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import socket
import struct
import termios
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from understudy.api import names
from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import secure_channel
from understudy.api.protocol.agent_messages import AgentStatus, GateEpoch, ProtocolError
from understudy.api.protocol.secure_channel import AgentSecret, AuthenticationFailed, Channel
from understudy.api.protocol.session_keys import NotAuthentic
from understudy.process import connection_limits, source_queues
from understudy.process.connection_limits import ConnectionLimits

_logger = logging.getLogger(__name__)

MOST_SESSIONS = 8
"""Sessions that have proved the token. A workload has one monitor, and for a moment two."""

GREETING = 3.0
"""Seconds to prove the token."""

SEND = 3.0
"""Seconds in which the other side must receive what is sent."""

MOST_REQUESTS = 32
"""Requests of one session that are carried out at the same time. Some, such as an initialization, take long."""

MOST_EVENTS = 512
"""Events that wait to be sent in a session. One more ends the session, and the monitor asks for the current state
again."""

_TCP_USER_TIMEOUT = getattr(socket, "TCP_USER_TIMEOUT", 18)
_UNACKNOWLEDGED = 6000  # milliseconds


class Refused(Exception):
    """The request cannot be carried out. The text of the error is the reason."""


@dataclass(frozen=True)
class Peer:
    """The other side of a session."""

    workload: str
    claim: str
    host: str
    """IP address."""
    probe_key: bytes = field(default=b"", repr=False)
    """Authenticates the gate probes that it requests; empty if its version of the protocol has none."""


Operation = Callable[[Mapping[str, Any], Peer], Awaitable[Mapping[str, Any] | None]]
"""Carries out a request's body for a peer, and returns the fields of the answer besides ``ok``. Raises Refused."""


class AgentInterface(Protocol):
    """The agent, as the sessions use it."""

    @property
    def uid(self) -> str:
        """The UID of the pod."""

    def secret(self) -> AgentSecret:
        """Return the token, and the monitor's key. Raises OSError."""

    def refuses(self, workload: str, claim: str) -> str | None:
        """Return why a monitor may not command this pod; None if it may."""

    def outdated(self, epoch: GateEpoch) -> str | None:
        """Why a request of this epoch may not be carried out; None if it may. Remembers the newest epoch."""

    def status(self) -> AgentStatus:
        """Return the state of the instance."""

    @property
    def version(self) -> int:
        """Grows with every change of the status."""

    async def changed(self, version: int) -> None:
        """Wait until the status is newer than this version."""

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that a monitor can request, by their ``op``."""


class _Session:
    """A connection whose other side has proved the token."""

    def __init__(self, channel: Channel, host: str, writer: asyncio.StreamWriter) -> None:
        self.peer = Peer(channel.workload, channel.claim, host, channel.probe_key)
        self.events: asyncio.Queue[Mapping[str, Any]] = asyncio.Queue(MOST_EVENTS)
        self.wants_events = True
        """False once a monitor has said that it does not. The events are about goals, for the task proxy."""
        self._channel, self._writer = channel, writer
        self._sending = asyncio.Lock()
        self._statuses = 0
        """How many statuses were sent."""
        self._recent: deque[tuple[int, float]] = deque()
        """The numbers of the statuses that were sent of late, and when (monotonic seconds)."""

    async def send(self, message: Mapping[str, Any]) -> None:
        async with self._sending, asyncio.timeout(SEND):
            self._channel.write(message)
            await self._writer.drain()

    async def send_status(self, status: AgentStatus) -> None:
        self._statuses += 1
        now = time.monotonic()
        self._recent.append((self._statuses, now))
        while self._recent and now - self._recent[0][1] > wire.FRESH:
            self._recent.popleft()
        await self.send({"status": status.to_wire(), "number": self._statuses})

    def held_back(self, request: Mapping[str, Any]) -> bool:
        """Whether a request was sent long ago, by the last status that its sender had seen. One of version 0.1.0 does not name it."""
        seen, now = request.get("seen"), time.monotonic()
        if not isinstance(seen, int) or seen > self._statuses:
            return False
        return not any(number == seen and now - sent <= wire.FRESH for number, sent in self._recent)

    async def receive(self) -> dict[str, Any]:
        return await self._channel.read()

    async def end(self, reason: str) -> None:
        with contextlib.suppress(OSError):
            await self.send({"error": reason})
        self._writer.close()

    def abort(self) -> None:
        self._writer.transport.abort()

    def reset(self) -> None:
        """End the session and discard what was not delivered yet."""
        wire.reset(self._writer)

    @property
    def delivered(self) -> bool:
        """Whether the other side's kernel has received all that was sent."""
        sock, transport = self._writer.get_extra_info("socket"), self._writer.transport
        if transport.is_closing() or transport.get_write_buffer_size():
            return False
        try:
            return not any(fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, bytes(struct.calcsize("i"))))
        except (OSError, ValueError):
            return False


class ControlChannel:
    """Serves the control channel."""

    def __init__(self, served: AgentInterface) -> None:
        self._served = served
        self._pending = ConnectionLimits()
        """Sessions that have not proved the token yet, so that strangers cannot keep a monitor out."""
        self._sessions: list[_Session] = []
        self._last_refusal = ""

    async def serve(self, port: int = names.AGENT_PORT, *, host: str | None = None) -> source_queues.Server:
        """Listen on a host; on all addresses if none is given. Raises OSError."""
        return await connection_limits.start_server(
            self._connected, host, port, limit=wire.MAX_GREETING, limits=self._pending
        )

    @property
    def count(self) -> int:
        """Number of sessions with monitors that may command this pod."""
        return len(self._sessions)

    def publish(self, event: Mapping[str, Any]) -> None:
        """Send an event to all sessions that want it, in order. A session that does not receive its events is ended.

        Feedback is most of them, and may come 100 times a second.
        """
        for session in [one for one in self._sessions if one.wants_events]:
            try:
                session.events.put_nowait(event)
            except asyncio.QueueFull:
                _logger.warning("session of %s does not receive its events", session.peer.host)
                session.abort()

    def delivered(self) -> bool:
        """Whether the other side of a session has received all that was sent to it."""
        return any(session.delivered for session in self._sessions)

    def abort(self) -> None:
        """End all sessions at once."""
        for session in list(self._sessions):
            session.reset()

    async def end_refused(self) -> None:
        """End the sessions of monitors that may no longer command this pod."""
        for session in list(self._sessions):
            if (reason := self._served.refuses(session.peer.workload, session.peer.claim)) is not None:
                await session.end(reason)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # None if the other side was gone before the connection was accepted.
        host = (writer.get_extra_info("peername") or ("?",))[0]
        try:
            self._limit_silence(writer)
            async with asyncio.timeout(GREETING):
                session = await self._let_in(reader, writer, host)
            if session is not None:
                self._pending.release(writer.transport)
                await self._follow(session)
        except (OSError, EOFError, ProtocolError) as error:
            _logger.debug("session of %s: %r", host, error)
        except Exception:
            _logger.exception("session of %s", host)
        finally:
            writer.close()

    def _limit_silence(self, writer: asyncio.StreamWriter) -> None:
        """Let the kernel detect that the other side has gone.

        The agent sends the status every second, so the other side has gone if nothing is acknowledged.
        """
        sock = writer.get_extra_info("socket")
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, _TCP_USER_TIMEOUT, _UNACKNOWLEDGED)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    async def _let_in(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str) -> _Session | None:
        try:
            channel = await secure_channel.accept(reader, writer, uid=self._served.uid, secret=self._served.secret)
        except AuthenticationFailed as failed:
            self._note_refusal(host, failed.workload, failed.claim, str(failed))
            return None
        session = _Session(channel, host, writer)
        peer = session.peer
        if (refusal := self._served.refuses(peer.workload, peer.claim)) is not None:
            self._note_refusal(host, peer.workload, peer.claim, refusal)
            await session.end(refusal)
            return None
        return session

    def _note_refusal(self, host: str, workload: str, claim: str, reason: str) -> None:
        """Log a refusal once: a refused monitor tries again and again."""
        text = f"{host} (workload {workload!r:.200}, claim {claim!r:.200}): {reason}"
        if text != self._last_refusal:
            self._last_refusal = text
            _logger.warning("refused %s", text)

    async def _follow(self, session: _Session) -> None:
        while len(self._sessions) >= MOST_SESSIONS:
            await self._sessions.pop(0).end("too many sessions: a newer one replaced this one")
        self._sessions.append(session)
        peer = session.peer
        _logger.info("session of %s (workload %r, claim %r)", peer.host, peer.workload, peer.claim)
        working = {asyncio.create_task(self._send_statuses(session)), asyncio.create_task(self._pass_on(session))}
        standing = len(working)
        try:
            while True:
                request = await session.receive()
                if len(working) - standing >= MOST_REQUESTS:
                    await session.send(
                        {"id": request.get("id"), "error": f"more than {MOST_REQUESTS} requests at once"}
                    )
                    continue
                task = asyncio.create_task(self._serve(request, session))
                working.add(task)
                task.add_done_callback(working.discard)
        except NotAuthentic as error:
            self._note_refusal(peer.host, peer.workload, peer.claim, str(error))
        finally:
            for task in working:
                task.cancel()
            with contextlib.suppress(ValueError):
                self._sessions.remove(session)

    async def _serve(self, request: Mapping[str, Any], session: _Session) -> None:
        """Carry out one request. It is cancelled when the session ends: the next monitor repeats it."""
        answer = await self._answer(request, session)
        try:
            await session.send(answer)
        except (OSError, ProtocolError) as error:
            _logger.debug("session of %s: %r", session.peer.host, error)
            session.abort()

    async def _pass_on(self, session: _Session) -> None:
        """Send the events in their order."""
        try:
            while True:
                await session.send({"event": await session.events.get()})
        except (OSError, ProtocolError) as error:
            _logger.debug("session of %s: %r", session.peer.host, error)
            session.abort()

    async def _send_statuses(self, session: _Session) -> None:
        """Send the status on every change and once a second. A session that cannot receive it is ended."""
        try:
            while True:
                version = self._served.version
                await session.send_status(self._served.status())
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wire.STATUS_PERIOD):
                        await self._served.changed(version)
        except OSError as error:
            _logger.debug("session of %s: %r", session.peer.host, error)
        except asyncio.CancelledError:
            raise
        except Exception:
            _logger.exception("telling %s the status", session.peer.host)
        session.abort()

    async def _answer(self, request: Mapping[str, Any], session: _Session) -> dict[str, Any]:
        number, op, peer = request.get("id"), request.get("op"), session.peer
        operations = self._served.operations()
        try:
            if (reason := self._served.refuses(peer.workload, peer.claim)) is not None:
                raise Refused(reason)
            if op == "status":
                return {"id": number, "ok": True, "status": self._served.status().to_wire()}
            if not isinstance(op, str) or op not in operations:
                raise Refused(f"unknown op {op!r}; there are {', '.join(operations)} and status")
            if session.held_back(request):
                held_back = f"the request arrived more than {wire.FRESH:g} s after what its sender had seen last"
                return {"id": number, "error": held_back, "heldBack": True}
            if (reason := self._served.outdated(GateEpoch.from_wire(request.get("gate")))) is not None:
                raise Refused(reason)
            if op == "configure" and request.get("events") is False:  # monitors of earlier versions do not say
                session.wants_events = False
            found = await operations[op](request, peer)
        except Refused as error:
            return {"id": number, "error": str(error)}
        except Exception as error:
            _logger.exception("op %s", op)
            return {"id": number, "error": f"{op} failed: {error!r}"}
        if op == "start":
            await self.end_refused()
        return {**(found or {}), "id": number, "ok": True}
