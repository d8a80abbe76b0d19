"""The part of DDS's wire protocol (RTPS 2.x, section 9) that is needed to learn what endpoints announce.

ROS's graph shows who reads and writes a topic, but neither the addresses and ports of readers nor the partitions of writers: DDS
does not expose those. All functions are pure functions of bytes; the conversation is in endpoint_announcements.py. This side
supports IPv4 only, because a robot's whole graph uses that transport.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from understudy.ros.dds.host_ids import VENDOR
from understudy.ros.middleware import Locator

PARTICIPANT = bytes([0x00, 0x00, 0x01, 0xC1])
"""The entity of the participant itself. The next two are the writer and the reader of its announcements and
subscriptions."""


class Endpoints(NamedTuple):
    """Discovery's own endpoints for one kind of entity."""

    writer: bytes
    reader: bytes
    detector: int
    """Bit of a participant's announcement that it has the reader."""


PARTICIPANTS = Endpoints(bytes([0x00, 0x01, 0x00, 0xC2]), bytes([0x00, 0x01, 0x00, 0xC7]), 1 << 1)
PUBLICATIONS = Endpoints(bytes([0x00, 0x00, 0x03, 0xC2]), bytes([0x00, 0x00, 0x03, 0xC7]), 1 << 3)
SUBSCRIPTIONS = Endpoints(bytes([0x00, 0x00, 0x04, 0xC2]), bytes([0x00, 0x00, 0x04, 0xC7]), 1 << 5)

ANNOUNCER = 1 << 0
"""Bit of an announcement that the participant announces itself."""

ANSWERED = {one.writer: one.reader for one in (PARTICIPANTS, PUBLICATIONS, SUBSCRIPTIONS)}
"""The writers whose heartbeats are answered, with the readers that answer."""

PREFIX = 12
"""Length in bytes of the participant's part of a GUID; its entity follows."""

MOST_MISSING = 256
"""Number of samples that one answer can request."""

_HEADER = b"RTPS" + bytes([2, 2]) + VENDOR
_LITTLE = 1  # the flag of every submessage with little-endian numbers
_ACKNACK, _HEARTBEAT, _GAP, _INFO_DST, _DATA = 0x06, 0x07, 0x08, 0x0E, 0x15
_INLINE_QOS, _HAS_DATA, _HAS_KEY = 2, 4, 8
_PL_CDR_LE = bytes([0x00, 0x03, 0x00, 0x00])

_PAD, _SENTINEL, _LEASE, _TOPIC, _VERSION, _VENDOR, _UNICAST = 0x00, 0x01, 0x02, 0x05, 0x15, 0x16, 0x2F
_PARTITION, _MULTICAST, _DEFAULT, _METATRAFFIC, _PARTICIPANT_GUID, _BUILTIN = 0x29, 0x30, 0x31, 0x32, 0x50, 0x58
_PROPERTIES, _ENDPOINT_GUID, _KEY_HASH, _STATUS, _RELATED = 0x59, 0x5A, 0x70, 0x71, 0x83
_RELATED_OF_EPROSIMA = 0x800F

_GONE = 3  # bits of a status: disposed, unregistered
_UDPV4, _UDPV6 = 1, 2
_WRITERS = (0x02, 0x03)
"""Last byte of the GUID of an application's writer, with and without keys."""


@dataclass(frozen=True)
class Participant:
    """A participant's announcement of itself."""

    prefix: bytes
    """The first bytes of the GUIDs of all its entities."""
    discovery: tuple[Locator, ...]
    """Where it listens for the traffic of discovery."""
    default: tuple[Locator, ...]
    """Where those of its readers listen that have no locators of their own."""


@dataclass(frozen=True)
class Reader:
    """A participant's announcement of one of its readers."""

    guid: bytes
    topic: str
    """The name in DDS, such as ``rt/cmd_vel``."""
    locators: tuple[Locator, ...]
    """The reader's own locators, multicast included; empty for the participant's default."""


@dataclass(frozen=True)
class Writer:
    """A participant's announcement of one of its writers."""

    guid: bytes
    topic: str
    partitions: tuple[str, ...]
    """Empty for the default partition."""


@dataclass(frozen=True)
class Sample:
    """A sample of a discovery writer."""

    writer: bytes
    number: int
    entity: Participant | Reader | Writer | None
    """None if the sample reports that an entity is gone, or describes an entity that is not needed."""


@dataclass(frozen=True)
class Heartbeat:
    """The range of samples that a writer has."""

    writer: bytes
    first: int
    last: int


@dataclass(frozen=True)
class Gap:
    """Samples of a writer that are irrelevant."""

    writer: bytes
    numbers: frozenset[int]


Submessage = Sample | Heartbeat | Gap

_Parameters = Sequence[tuple[int, bytes]]


# -- reading ------------------------------------------------------------------------------------------------------------


def parse(datagram: bytes) -> Iterator[Submessage]:
    """Yield the submessages of a datagram; none if it is not RTPS. Raises ValueError if it is malformed."""
    if len(datagram) < 20 or datagram[:4] != b"RTPS":
        return
    prefix, at = datagram[8:20], 20
    while at + 4 <= len(datagram):
        kind, flags = datagram[at], datagram[at + 1]
        order = "<" if flags & _LITTLE else ">"
        (length,) = struct.unpack_from(f"{order}H", datagram, at + 2)
        end = at + 4 + length if length else len(datagram)  # the last one may have a length of 0
        found = _submessage(kind, flags, order, datagram[at + 4 : end], prefix)
        if found is not None:
            yield found
        at = end


def _submessage(kind: int, flags: int, order: str, body: bytes, prefix: bytes) -> Submessage | None:
    try:
        if kind == _HEARTBEAT:
            return Heartbeat(prefix + body[4:8], _number(order, body, 8), _number(order, body, 16))
        if kind == _GAP:
            return Gap(prefix + body[4:8], frozenset(_gone(order, body)))
        if kind == _DATA:
            return _sample(flags, order, body, prefix)
    except (struct.error, IndexError) as error:
        raise ValueError(f"an RTPS submessage of kind {kind} is broken: {error}") from error
    return None


def _number(order: str, body: bytes, at: int) -> int:
    high, low = struct.unpack_from(f"{order}iI", body, at)
    return int((high << 32) + low)


def _gone(order: str, body: bytes) -> Iterator[int]:
    """Yield the numbers of a gap: a range, and then some numbers from a bitmap."""
    start, base = _number(order, body, 8), _number(order, body, 16)
    yield from range(start, min(base, start + 65536))
    (count,) = struct.unpack_from(f"{order}I", body, 24)
    for bit in range(min(count, MOST_MISSING)):
        (word,) = struct.unpack_from(f"{order}I", body, 28 + bit // 32 * 4)
        if word & 1 << (31 - bit % 32):
            yield base + bit


def _sample(flags: int, order: str, body: bytes, prefix: bytes) -> Sample:
    (to_inline,) = struct.unpack_from(f"{order}H", body, 2)
    writer, number = prefix + body[8:12], _number(order, body, 12)
    rest = body[4 + to_inline :]
    gone = bool(flags & _HAS_KEY)
    if flags & _INLINE_QOS:
        inline, size = _parameters(rest, order)
        gone |= any(pid == _STATUS and value[3] & _GONE for pid, value in inline)
        rest = rest[size:]
    if gone or not flags & _HAS_DATA or len(rest) < 4:
        return Sample(writer, number, None)
    order = "<" if rest[1] & _LITTLE else ">"
    parameters, _ = _parameters(rest[4:], order)
    return Sample(writer, number, _entity(parameters, order))


def _parameters(data: bytes, order: str) -> tuple[list[tuple[int, bytes]], int]:
    """Return the parameters of a list, and the length of the list."""
    found: list[tuple[int, bytes]] = []
    at = 0
    while at + 4 <= len(data):
        pid, length = struct.unpack_from(f"{order}HH", data, at)
        at += 4
        if pid == _SENTINEL:
            break
        found.append((pid, data[at : at + length]))
        at += length
    return found, at


def _entity(parameters: _Parameters, order: str) -> Participant | Reader | Writer | None:
    values = dict(parameters)

    def locators(*pids: int) -> tuple[Locator, ...]:
        found = (_locator(value, order) for pid, value in parameters if pid in pids)
        return tuple(dict.fromkeys(one for one in found if one is not None))

    if _ENDPOINT_GUID in values and _TOPIC in values:
        topic, _ = _string(values[_TOPIC], 0, order)
        guid = values[_ENDPOINT_GUID]
        if guid[-1] in _WRITERS:
            return Writer(guid, topic, _partitions(values.get(_PARTITION), order))
        return Reader(guid, topic, locators(_UNICAST, _MULTICAST))
    if _PARTICIPANT_GUID in values:
        return Participant(values[_PARTICIPANT_GUID][:PREFIX], locators(_METATRAFFIC), locators(_DEFAULT))
    return None


def _partitions(value: bytes | None, order: str) -> tuple[str, ...]:
    if value is None:
        return ()
    (count,) = struct.unpack_from(f"{order}I", value, 0)
    names, at = [], 4
    for _ in range(count):
        name, at = _string(value, at, order)
        names.append(name)
    return tuple(name for name in names if name)


def _string(value: bytes, at: int, order: str) -> tuple[str, int]:
    """Return a string and the position after it, which is a multiple of four. Raises struct.error at the end of the value."""
    (size,) = struct.unpack_from(f"{order}I", value, at)
    text = value[at + 4 : at + 4 + size].rstrip(b"\0").decode(errors="replace")
    return text, at + 4 + (size + 3) // 4 * 4


def _locator(value: bytes, order: str) -> Locator | None:
    kind, port = struct.unpack_from(f"{order}iI", value, 0)
    if kind == _UDPV4:
        return Locator(str(ipaddress.IPv4Address(value[20:24])), port)
    if kind == _UDPV6:
        return Locator(str(ipaddress.IPv6Address(value[8:24])), port)
    return None


# -- writing ------------------------------------------------------------------------------------------------------------


def announcement(prefix: bytes, at: Locator, asked: Endpoints, *, lease: float, kind: str, to: bytes = b"") -> bytes:
    """Return a participant's own announcement: it listens at ``at``, and asks for participants and one kind of endpoint.

    ``kind`` is the kind of client that a discovery server considers it; ``to`` is the prefix of that server, empty for
    all that receive the announcement.
    """
    where = struct.pack("<iI12x", _UDPV4, at.port) + ipaddress.IPv4Address(at.address).packed
    parameters = [
        (_VERSION, bytes([2, 2, 0, 0])),
        (_VENDOR, VENDOR + bytes(2)),
        (_PARTICIPANT_GUID, prefix + PARTICIPANT),
        (_METATRAFFIC, where),
        (_DEFAULT, where),
        (_LEASE, struct.pack("<iI", int(lease), 0)),
        (_BUILTIN, struct.pack("<I", ANNOUNCER | PARTICIPANTS.detector | asked.detector)),
        (_PROPERTIES, _properties({"PARTICIPANT_TYPE": kind, "DS_VERSION": "2.0"})),
    ]
    return _message(prefix, to, _data(prefix, 1, parameters))


def farewell(prefix: bytes, *, to: bytes = b"") -> bytes:
    """Return the announcement that a participant and all its entities are gone."""
    gone = [(_KEY_HASH, prefix + PARTICIPANT), (_STATUS, bytes([0, 0, 0, _GONE]))]
    return _message(prefix, to, _data(prefix, 2, inline=gone))


def acknowledgement(prefix: bytes, writer: bytes, missing: Sequence[int], *, then: int, count: int) -> bytes:
    """Return a reader's request for the missing samples of a writer, oldest first.

    ``then`` is the number of the next sample.
    """
    base = missing[0] if missing else then
    wanted = [number - base for number in missing if number - base < MOST_MISSING]
    bits = wanted[-1] + 1 if wanted else 0
    words = [0] * ((bits + 31) // 32)
    for bit in wanted:
        words[bit // 32] |= 1 << (31 - bit % 32)
    entity = writer[PREFIX:]
    body = ANSWERED[entity] + entity + struct.pack("<iI", base >> 32, base & 0xFFFFFFFF)
    body += struct.pack(f"<I{len(words)}II", bits, *words, count)
    final = 0 if missing else 2
    return _message(prefix, writer[:PREFIX], _framed(_ACKNACK, final, body))


def _message(prefix: bytes, to: bytes, *submessages: bytes) -> bytes:
    return b"".join([_HEADER, prefix, *([_framed(_INFO_DST, 0, to)] if to else []), *submessages])


def _framed(kind: int, flags: int, body: bytes) -> bytes:
    return struct.pack("<BBH", kind, flags | _LITTLE, len(body)) + body


def _data(prefix: bytes, number: int, parameters: _Parameters = (), *, inline: _Parameters = ()) -> bytes:
    writer, reader, _ = PARTICIPANTS
    # A discovery server passes the announcement on as its own. This field identifies the original writer.
    identity = prefix + writer + struct.pack("<iI", 0, number)
    body = struct.pack("<HH", 0, 16) + reader + writer + struct.pack("<iI", 0, number)
    body += _listed([(_RELATED, identity), (_RELATED_OF_EPROSIMA, identity), *inline])
    if parameters:
        body += _PL_CDR_LE + _listed(parameters)
    return _framed(_DATA, _INLINE_QOS | (_HAS_DATA if parameters else 0), body)


def _listed(parameters: _Parameters) -> bytes:
    encoded = (struct.pack("<HH", pid, len(value)) + value for pid, value in parameters)
    return b"".join(encoded) + struct.pack("<HH", _SENTINEL, 0)


def _properties(values: dict[str, str]) -> bytes:
    return struct.pack("<I", len(values)) + b"".join(_text(text) for pair in values.items() for text in pair)


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)
