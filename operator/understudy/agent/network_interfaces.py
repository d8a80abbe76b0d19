"""Finds the network interfaces of the agent's pod besides that of the pod network. The gate does not control them."""

from __future__ import annotations

import ctypes
import logging
import math
import socket
from collections.abc import Iterator, Mapping
from ipaddress import IPv4Address, IPv6Address, ip_address

_logger = logging.getLogger(__name__)

PERIOD = 5.0
"""Minimum seconds between two looks at the interfaces: a network plugin may add one to a pod that runs already."""

_UP, _LOOPBACK = 0x1, 0x8
"""Flags of an interface, of netdevice(7)."""

_PLACES: dict[int, tuple[int, int]] = {socket.AF_INET: (4, 4), socket.AF_INET6: (8, 16)}
"""By address family, the offset and size of the address in its socket address."""


class FurtherInterfaces:
    """The interfaces that are up and have an address besides link-local ones, except the loopback and the one with the pod's address.

    The address in the pod's status says which interface is that of the pod network, because gates apply to the pods with that address.
    Routes would not: a network plugin may give a further interface the default route.
    """

    def __init__(self, pod_ip: str) -> None:
        """``pod_ip`` is the address in the pod's status. Nothing is found if no interface has it."""
        self._own: IPv4Address | IPv6Address | None = None
        try:
            self._own = ip_address(pod_ip)
        except ValueError:
            _logger.info("%r is not the pod's address, so further interfaces are not noticed", pod_ip)
        self._looked_at = -math.inf
        self._found: Mapping[str, tuple[str, ...]] = {}

    def seen(self, now: float) -> Mapping[str, tuple[str, ...]]:
        """Return the addresses of each further interface at ``now`` (monotonic seconds), or up to PERIOD earlier."""
        if self._own is not None and now - self._looked_at >= PERIOD:
            self._looked_at = now
            try:
                self._found = _further(self._own)
            except OSError as error:
                _logger.warning("cannot list the network interfaces: %s", error)
        return self._found


def _further(own: IPv4Address | IPv6Address) -> dict[str, tuple[str, ...]]:
    interfaces: dict[str, list[IPv4Address | IPv6Address]] = {}
    for name, address in _addresses():
        interfaces.setdefault(name, []).append(address)
    if not any(own in addresses for addresses in interfaces.values()):
        return {}
    routable = {
        name: tuple(str(address) for address in addresses if not address.is_link_local)
        for name, addresses in sorted(interfaces.items())
        if own not in addresses
    }
    return {name: addresses for name, addresses in routable.items() if addresses}


class _Entry(ctypes.Structure):
    """The first fields of struct ifaddrs of getifaddrs(3)."""


_Entry._fields_ = [
    ("next", ctypes.POINTER(_Entry)),
    ("name", ctypes.c_char_p),
    ("flags", ctypes.c_uint),
    ("address", ctypes.c_void_p),
]


def _addresses() -> Iterator[tuple[str, IPv4Address | IPv6Address]]:
    """Yield the name and each address of every interface that is up and not the loopback. Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    first = ctypes.POINTER(_Entry)()
    if libc.getifaddrs(ctypes.byref(first)):
        raise OSError(ctypes.get_errno(), "getifaddrs failed")
    try:
        entry = first
        while entry:
            found = entry.contents
            entry = found.next
            if not found.address or not found.flags & _UP or found.flags & _LOOPBACK:
                continue
            family = ctypes.c_ushort.from_address(found.address).value
            if family in _PLACES:
                offset, size = _PLACES[family]
                # The name of an address may have a label: eth0:1.
                name = found.name.decode(errors="replace").partition(":")[0]
                yield name, ip_address(ctypes.string_at(found.address + offset, size))
    finally:
        libc.freeifaddrs(first)
