"""Asks DDS discovery what endpoints announce: where readers listen, and in which partitions writers are.

A bare participant joins the robot's graph briefly, and leaves it again. It has only discovery's own endpoints, so nobody sends data to
it and no node appears. A discovery server announces all endpoints to it, as to a super client. Without a server, every participant
announces its own. With the range LOCALHOST, the participants of this host are asked one by one.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import secrets
import socket
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from understudy.ros.dds import rtps
from understudy.ros.dds.host_ids import VENDOR
from understudy.ros.dds.rtps import Gap, Heartbeat, Participant, Reader, Sample, Writer
from understudy.ros.middleware import Locator

_logger = logging.getLogger(__name__)

T = TypeVar("T")

AGAIN = 0.5
"""Seconds between two announcements of the participant while it stays: one may be lost."""

LEASE = 10.0
"""Seconds after which others forget the participant if its farewell is lost."""

RESPONSE = 0.005
"""Seconds from a heartbeat to the answer: most of the samples that it announces are already on their way."""

PORTS, _OURS = 250, 50
"""Number of DDS ports of a ROS domain, and how many of them are tried: the last ones, which other participants take last. A firewall that
accepts the ports of a domain accepts these.
"""

_FIRST_PARTICIPANT, _LOCAL = 10, 32
"""The port of the first participant after the first one of a domain, and how many participants of a host find each other without
multicast: as many as in rmw_fastrtps."""

_SERVER = bytes.fromhex("4453005f4550524f53494d41")
"""GUID prefix of the first discovery server of a list. A robot has no other."""


@dataclass(frozen=True)
class Discovery:
    """The discovery to ask."""

    host: str
    port: int
    prefix: bytes = b""
    """GUID prefix of a discovery server; empty for all participants that receive the announcement."""
    domain: int = 0
    participants: int = 1
    """Number of participants that are asked one by one, from this port on. One also stands for a server, and for a multicast address."""

    @property
    def ports(self) -> range:
        """Where the participants listen for discovery: every second port."""
        return range(self.port, self.port + 2 * self.participants, 2)

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Discovery:
        """Read from the environment variables of ROS. Raises ValueError if they are invalid."""
        server, domain = environment.get("ROS_DISCOVERY_SERVER", ""), int(environment.get("ROS_DOMAIN_ID") or 0)
        if server:
            host, _, port = server.rpartition(":")
            return cls(host, int(port), _SERVER, domain)
        if (
            environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
        ):  # then nobody listens at the multicast address
            return cls("127.0.0.1", first_port(domain) + _FIRST_PARTICIPANT, domain=domain, participants=_LOCAL)
        return cls("239.255.0.1", first_port(domain), domain=domain)


async def locators(
    wanted: Collection[bytes], address: str, discovery: Discovery, *, within: float
) -> dict[bytes, tuple[Locator, ...]]:
    """Return where the readers with these GUIDs listen.

    Those that are not announced within ``within`` seconds are left out. Returns as soon as all are known: the discovery
    server of a small graph has announced everything after half a second. ``address`` is this host's own, to which
    answers are sent. Raises OSError.
    """
    return await _asked(lambda seen: seen.places(wanted), len(wanted), rtps.SUBSCRIPTIONS, address, discovery, within)


async def partitions(
    wanted: Collection[bytes], address: str, discovery: Discovery, *, within: float
) -> dict[bytes, tuple[str, ...]]:
    """Return the partitions of the writers with these GUIDs; none for a writer in the default one.

    Everything else is as for :func:`locators`.
    """
    return await _asked(
        lambda seen: seen.partitions(wanted), len(wanted), rtps.PUBLICATIONS, address, discovery, within
    )


@dataclass
class _Announced:
    """What the endpoints of a graph announced so far, by GUID; participants by prefix."""

    participants: dict[bytes, Participant] = field(default_factory=dict)
    readers: dict[bytes, Reader] = field(default_factory=dict)
    writers: dict[bytes, Writer] = field(default_factory=dict)

    def places(self, wanted: Iterable[bytes]) -> dict[bytes, tuple[Locator, ...]]:
        """Return where the wanted readers listen, as far as known."""
        places: dict[bytes, tuple[Locator, ...]] = {}
        for guid in wanted:
            if (reader := self.readers.get(guid)) is None:
                continue
            if reader.locators:
                places[guid] = reader.locators
            elif (participant := self.participants.get(guid[: rtps.PREFIX])) is not None:
                places[guid] = participant.default
        return places

    def partitions(self, wanted: Iterable[bytes]) -> dict[bytes, tuple[str, ...]]:
        """Return the partitions of the wanted writers, as far as known."""
        return {guid: self.writers[guid].partitions for guid in wanted if guid in self.writers}


async def _asked(
    answer: Callable[[_Announced], dict[bytes, T]],
    complete: int,
    endpoints: rtps.Endpoints,
    address: str,
    discovery: Discovery,
    within: float,
) -> dict[bytes, T]:
    """Visit the graph until an answer has this number of entries, or for ``within`` seconds."""
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(discovery.host, discovery.port, family=socket.AF_INET, type=socket.SOCK_DGRAM)
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        listener.setblocking(False)
        listener.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
        _bind(listener, discovery.domain)
        to = [(str(found[0][4][0]), port) for port in discovery.ports]
        at = Locator(address, listener.getsockname()[1])
        visit = _Visit(lambda seen: len(answer(seen)) == complete, endpoints, at, to, discovery.prefix)
        visit.transport, _ = await loop.create_datagram_endpoint(lambda: visit, sock=listener)
        stack.callback(visit.leave)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within):
                while not visit.over.is_set():
                    visit.announce()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(AGAIN):
                            await visit.over.wait()
        return answer(visit.announced)


def first_port(domain: int) -> int:
    """Return the first of the DDS ports of a ROS domain."""
    return 7400 + PORTS * domain


def _bind(listener: socket.socket, domain: int) -> None:
    """Bind a free port of the domain. Raises OSError if there is none."""
    end = first_port(domain) + PORTS
    for port in range(end - 1, end - _OURS, -1):
        with contextlib.suppress(OSError):
            return listener.bind(("", port))
    raise OSError(f"no UDP port of {end - _OURS} to {end - 1} is free")


class _Visit(asyncio.DatagramProtocol):
    """One visit to a graph."""

    def __init__(
        self,
        enough: Callable[[_Announced], bool],
        endpoints: rtps.Endpoints,
        at: Locator,
        to: Sequence[tuple[str, int]],
        server: bytes,
    ) -> None:
        self.announced = _Announced()
        self.over = asyncio.Event()
        """Set once enough is known."""
        self._enough, self._endpoints = enough, endpoints
        self._at, self._to, self._server = at, to, server
        self._prefix = VENDOR + secrets.token_bytes(10)
        self.transport: asyncio.DatagramTransport | None = None
        """The socket, while the participant is in the graph."""
        self._had: dict[bytes, set[int]] = {}
        self._heartbeats: dict[bytes, Heartbeat] = {}
        self._answers = itertools.count(1)

    def announce(self) -> None:
        """Announce the participant."""
        kind = "SUPER_CLIENT" if self._server else "SIMPLE"
        asked = self._endpoints
        self._send(rtps.announcement(self._prefix, self._at, asked, lease=LEASE, kind=kind, to=self._server))

    def leave(self) -> None:
        """Announce that the participant leaves, and close the socket."""
        self._send(rtps.farewell(self._prefix, to=self._server))
        if self.transport is not None:
            self.transport.close()
            self.transport = None

    def _send(self, datagram: bytes, to: Iterable[Locator] = ()) -> None:
        if self.transport is not None:
            for place in [(one.address, one.port) for one in to] or self._to:
                self.transport.sendto(datagram, place)

    # -- asyncio.DatagramProtocol -------------------------------------------------------------------------------------

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        try:
            for submessage in rtps.parse(data):
                self._take(submessage)
        except ValueError as error:
            _logger.debug("from %s: %s", addr[0], error)

    def error_received(self, exc: Exception) -> None:
        _logger.debug("asking discovery: %s", exc)

    # -- received ----------------------------------------------------------------------------------------------------------

    def _take(self, submessage: Sample | Heartbeat | Gap) -> None:
        if isinstance(submessage, Gap):
            self._had.setdefault(submessage.writer, set()).update(submessage.numbers)
        elif isinstance(submessage, Heartbeat):
            if submessage.writer[rtps.PREFIX :] in rtps.ANSWERED and submessage.writer not in self._heartbeats:
                asyncio.get_running_loop().call_later(RESPONSE, self._answer, submessage.writer)
            self._heartbeats[submessage.writer] = submessage
        else:
            self._had.setdefault(submessage.writer, set()).add(submessage.number)
            match submessage.entity:
                case Reader() as reader:
                    self.announced.readers[reader.guid] = reader
                case Writer() as writer:
                    self.announced.writers[writer.guid] = writer
                case Participant() as participant:
                    self.announced.participants[participant.prefix] = participant
            if self._enough(self.announced):
                self.over.set()

    def _answer(self, writer: bytes) -> None:
        """Request the samples of a writer that were not received yet."""
        heartbeat, had = self._heartbeats.pop(writer), self._had.get(writer, set())
        numbers = range(max(heartbeat.first, 1), heartbeat.last + 1)
        missing = list(itertools.islice((n for n in numbers if n not in had), rtps.MOST_MISSING))
        if self._server:
            places: tuple[Locator, ...] = ()
        elif (participant := self.announced.participants.get(writer[: rtps.PREFIX])) is not None:
            places = participant.discovery
        else:
            return  # the writer repeats the heartbeat, also after its participant was announced
        answer = rtps.acknowledgement(self._prefix, writer, missing, then=heartbeat.last + 1, count=next(self._answers))
        self._send(answer, places)
