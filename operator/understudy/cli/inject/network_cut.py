"""The program that ``understudy inject partition`` runs in an ephemeral container: cuts the pod off from the network for a time.

It makes nf_tables drop incoming and outgoing packets at every interface except the loopback, also of existing connections. This
happens below the sockets: the application sees a pulled cable, and no send fails. The table belongs to a socket of this process, so
that the kernel removes it when the process ends for any reason.

The container's Python receives this file as text, because its image may have another version than the caller.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterable, Iterator, Sequence

LATEST = "UNDERSTUDY_LATEST"
"""Environment variable: the time in unix seconds after which the program does nothing."""

# From linux/netlink.h, linux/netfilter/nfnetlink.h and linux/netfilter/nf_tables.h; so are the numbers of attributes below.
_NETLINK_NETFILTER = 12
_REQUEST, _ACK, _CREATE, _APPEND = 0x1, 0x4, 0x400, 0x800
_ERROR, _BATCH_BEGIN, _BATCH_END = 2, 16, 17
_NF_TABLES, _NEW_TABLE, _NEW_CHAIN, _NEW_RULE = 10, 0, 3, 6
_NETDEV = 5
_OWNED = 2
_INGRESS, _EGRESS = 0, 1
_DROP, _ACCEPT = 0, 1
_NESTED = 0x8000
_VERDICT, _REGISTER = 0, 1
_PROTOCOL = 1
_NETWORK_HEADER = 1
_ETHERTYPES = {4: 0x0800, 6: 0x86DD}
_ADDRESSES = {4: (12, 16), 6: (8, 24)}
"""Offsets of source and destination in an IP header."""

_TOO_OLD = "the node's kernel does not support it: Linux 5.16 with nf_tables is required"

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class CannotCut(Exception):
    """The pod cannot be cut off; the message says why."""


@contextlib.contextmanager
def cut(networks: Sequence[Network]) -> Iterator[None]:
    """Cut this network namespace off from these networks, or from everything, for the duration of the context. Raises
    CannotCut."""
    try:
        held = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_NETFILTER)
    except OSError as error:
        raise CannotCut(f"{_TOO_OLD} ({error.strerror})") from error
    with held:
        held.bind((0, 0))
        held.settimeout(5.0)
        # The socket's port number distinguishes it from another cut of the same pod at the same time.
        table = b"understudy_partition_%d\0" % held.getsockname()[0]
        try:
            _commit(held, _changes(table, networks))
        except PermissionError as error:
            raise CannotCut("permission denied: the capability NET_ADMIN in the pod's network is required") from error
        except OSError as error:
            raise CannotCut(f"{_TOO_OLD} ({error.strerror or error})") from error
        yield


def _changes(table: bytes, networks: Sequence[Network]) -> Iterator[tuple[int, int, bytes]]:
    """Yield the messages for the table, its two chains and a rule per network: type, flags and attributes."""
    yield _NEW_TABLE, _CREATE, _attribute(1, table) + _number(2, _OWNED)
    devices = b"".join(_attribute(1, name.encode() + b"\0") for _, name in socket.if_nameindex() if name != "lo")
    for number, (chain, hook) in enumerate(((b"in\0", _INGRESS), (b"out\0", _EGRESS))):
        where = _number(1, hook) + _number(2, 0) + _nested(4, devices)
        policy = _number(5, _ACCEPT if networks else _DROP)
        named = _attribute(1, table) + _attribute(3, chain) + _attribute(7, b"filter\0")
        yield _NEW_CHAIN, _CREATE, named + _nested(4, where) + policy
        for network in networks:
            expressions = _of(network, _ADDRESSES[network.version][number])
            rule = (
                _attribute(1, table)
                + _attribute(2, chain)
                + _nested(4, b"".join(_nested(1, one) for one in expressions))
            )
            yield _NEW_RULE, _CREATE | _APPEND, rule


def _of(network: Network, offset: int) -> Iterator[bytes]:
    """Yield the expressions that drop packets with an address of a network at an offset of the header."""
    mask, address = network.netmask.packed, network.network_address.packed
    yield _expression(b"meta\0", _number(1, _REGISTER) + _number(2, _PROTOCOL))
    yield _equal(struct.pack("!H", _ETHERTYPES[network.version]))
    place = _number(2, _NETWORK_HEADER) + _number(3, offset) + _number(4, len(address))
    yield _expression(b"payload\0", _number(1, _REGISTER) + place)
    masked = _number(3, len(address)) + _nested(4, _attribute(1, mask)) + _nested(5, _attribute(1, bytes(len(address))))
    yield _expression(b"bitwise\0", _number(1, _REGISTER) + _number(2, _REGISTER) + masked)
    yield _equal(address)
    yield _expression(b"immediate\0", _number(1, _VERDICT) + _nested(2, _nested(2, _number(1, _DROP))))


def _equal(value: bytes) -> bytes:
    return _expression(b"cmp\0", _number(1, _REGISTER) + _number(2, 0) + _nested(3, _attribute(1, value)))


def _expression(name: bytes, data: bytes) -> bytes:
    return _attribute(1, name) + _nested(2, data)


def _attribute(kind: int, value: bytes) -> bytes:
    """Encode a netlink attribute."""
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def _number(kind: int, value: int) -> bytes:
    return _attribute(kind, struct.pack("!I", value))


def _nested(kind: int, attributes: bytes) -> bytes:
    return _attribute(kind | _NESTED, attributes)


def _commit(held: socket.socket, changes: Iterable[tuple[int, int, bytes]]) -> None:
    """Apply all changes or none. Raises OSError."""
    made = [
        _message(_NF_TABLES << 8 | kind, flags | _ACK, _NETDEV, 0, attributes) for kind, flags, attributes in changes
    ]
    begin, end = (_message(kind, 0, 0, _NF_TABLES, b"") for kind in (_BATCH_BEGIN, _BATCH_END))
    held.send(begin + b"".join(made) + end)
    answers = 0
    while answers < len(made):
        found = held.recv(65536)
        while found:
            length, kind = struct.unpack_from("=IH", found)
            if kind == _ERROR:
                (negative,) = struct.unpack_from("=i", found, 16)
                if negative:
                    raise OSError(-negative, os.strerror(-negative))
                answers += 1
            found = found[(length + 3) & ~3 :]


def _message(kind: int, flags: int, family: int, resource: int, attributes: bytes) -> bytes:
    body = struct.pack("!BBH", family, 0, resource) + attributes
    return struct.pack("=IHHII", 16 + len(body), kind, flags | _REQUEST, 0, 0) + body


def run(length: float, networks: Sequence[str]) -> None:
    """Cut off from these networks for a time, or until SIGTERM. Prints its progress as lines of JSON. Raises CannotCut."""
    ending = {signal.SIGTERM, signal.SIGINT}
    # Block and wait, because process 1 of a container does not receive signals without a handler.
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    if time.time() > float(os.environ[LATEST]):
        raise CannotCut("the container started too late; the caller no longer waits")
    with cut([ipaddress.ip_network(one) for one in networks]):
        print(json.dumps({"cut": time.time(), "process": os.getpid()}), flush=True)
        signal.sigtimedwait(ending, length)
    print(json.dumps({"back": time.time()}), flush=True)


if __name__ == "__main__":
    try:
        run(float(sys.argv[1]), sys.argv[2:])
    except CannotCut as error:
        sys.exit(str(error))
