"""Asks DDS discovery where readers listen: joins the robot's graph briefly as a bare participant, and leaves it again.

The participant has only discovery's own endpoints, so nobody sends data to it and no node appears. A discovery server announces all
readers to it, as to a super client. Without a server, every participant announces its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import secrets
import socket
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from understudy.ros.dds import rtps
from understudy.ros.dds.host_ids import VENDOR
from understudy.ros.dds.rtps import Gap, Heartbeat, Participant, Reader, Sample
from understudy.ros.middleware import Locator

_logger = logging.getLogger(__name__)

AGAIN = 0.5
"""Seconds between two announcements of the participant while it stays: one may be lost."""

LEASE = 10.0
"""Seconds after which others forget the participant if its farewell is lost."""

RESPONSE = 0.005
"""Seconds from a heartbeat to the answer: most of the samples that it announces are already on their way."""

_PORTS, _OURS = 250, 50
"""Number of DDS ports of a ROS domain, and how many of them are tried: the last ones, which other participants take last. A firewall that
accepts the ports of a domain accepts these.
"""

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

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Discovery:
        """Read from the environment variables of ROS. Raises ValueError if they are invalid."""
        server, domain = environment.get("ROS_DISCOVERY_SERVER", ""), int(environment.get("ROS_DOMAIN_ID") or 0)
        if server:
            host, _, port = server.rpartition(":")
            return cls(host, int(port), _SERVER, domain)
        return cls("239.255.0.1", _first_port(domain), domain=domain)


async def locators(
    wanted: Collection[bytes], address: str, discovery: Discovery, *, within: float
) -> dict[bytes, tuple[Locator, ...]]:
    """Return where the readers with these GUIDs listen.

    Those that are not announced within ``within`` seconds are left out. Returns as soon as all are known: the discovery
    server of a small graph has announced everything after half a second. ``address`` is this host's own, to which
    answers are sent. Raises OSError.
    """
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(discovery.host, discovery.port, family=socket.AF_INET, type=socket.SOCK_DGRAM)
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        listener.setblocking(False)
        listener.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
        _bind(listener, discovery.domain)
        to = (str(found[0][4][0]), discovery.port)
        visit = _Visit(wanted, Locator(address, listener.getsockname()[1]), to, discovery.prefix)
        visit.transport, _ = await loop.create_datagram_endpoint(lambda: visit, sock=listener)
        stack.callback(visit.leave)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within):
                while not visit.over.is_set():
                    visit.announce()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(AGAIN):
                            await visit.over.wait()
        return visit.found


def _first_port(domain: int) -> int:
    return 7400 + _PORTS * domain


def _bind(listener: socket.socket, domain: int) -> None:
    """Bind a free port of the domain. Raises OSError if there is none."""
    end = _first_port(domain) + _PORTS
    for port in range(end - 1, end - _OURS, -1):
        with contextlib.suppress(OSError):
            return listener.bind(("", port))
    raise OSError(f"no UDP port of {end - _OURS} to {end - 1} is free")


class _Visit(asyncio.DatagramProtocol):
    """One visit to a graph."""

    def __init__(self, wanted: Collection[bytes], at: Locator, to: tuple[str, int], server: bytes) -> None:
        self.over = asyncio.Event()
        """Set once all wanted readers are known."""
        self._wanted, self._at, self._to, self._server = wanted, at, to, server
        self._prefix = VENDOR + secrets.token_bytes(10)
        self.transport: asyncio.DatagramTransport | None = None
        """The socket, while the participant is in the graph."""
        self._participants: dict[bytes, Participant] = {}
        self._readers: dict[bytes, tuple[Locator, ...]] = {}
        self._had: dict[bytes, set[int]] = {}
        self._heartbeats: dict[bytes, Heartbeat] = {}
        self._answers = itertools.count(1)

    @property
    def found(self) -> dict[bytes, tuple[Locator, ...]]:
        """Return where the wanted readers listen, as far as known."""
        places: dict[bytes, tuple[Locator, ...]] = {}
        for guid in self._wanted:
            if (own := self._readers.get(guid)) is None:
                continue
            if own:
                places[guid] = own
            elif (participant := self._participants.get(guid[: rtps.PREFIX])) is not None:
                places[guid] = participant.default
        return places

    def announce(self) -> None:
        """Announce the participant."""
        kind = "SUPER_CLIENT" if self._server else "SIMPLE"
        self._send(rtps.announcement(self._prefix, self._at, lease=LEASE, kind=kind, to=self._server))

    def leave(self) -> None:
        """Announce that the participant leaves, and close the socket."""
        self._send(rtps.farewell(self._prefix, to=self._server))
        if self.transport is not None:
            self.transport.close()
            self.transport = None

    def _send(self, datagram: bytes, to: Iterable[Locator] = ()) -> None:
        if self.transport is not None:
            for place in [(one.address, one.port) for one in to] or [self._to]:
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
            if isinstance(submessage.entity, Reader):
                self._readers[submessage.entity.guid] = submessage.entity.locators
            elif isinstance(submessage.entity, Participant):
                self._participants[submessage.entity.prefix] = submessage.entity
            if len(self.found) == len(self._wanted):
                self.over.set()

    def _answer(self, writer: bytes) -> None:
        """Request the samples of a writer that were not received yet."""
        heartbeat, had = self._heartbeats.pop(writer), self._had.get(writer, set())
        numbers = range(max(heartbeat.first, 1), heartbeat.last + 1)
        missing = list(itertools.islice((n for n in numbers if n not in had), rtps.MOST_MISSING))
        if self._server:
            places: tuple[Locator, ...] = ()
        elif (participant := self._participants.get(writer[: rtps.PREFIX])) is not None:
            places = participant.discovery
        else:
            return  # the writer repeats the heartbeat, also after its participant was announced
        answer = rtps.acknowledgement(self._prefix, writer, missing, then=heartbeat.last + 1, count=next(self._answers))
        self._send(answer, places)
