"""The host ids in Fast DDS's GUIDs, which identify the host of an endpoint.

Fast DDS begins every GUID with its vendor's id and a 16-bit id of the host, which it derives from the IPv4 addresses of
the host's interfaces, loopback excluded (``Host`` in its ``utils``).
"""

from __future__ import annotations

import hashlib
import ipaddress
from functools import lru_cache

VENDOR = bytes([0x01, 0x0F])
"""First bytes of a GID of Fast DDS; the host's id follows."""

HOST = slice(0, 4)
"""The part of a GID that is the same for all writers of a host: the vendor and the host's id."""

PARTICIPANT = slice(0, 12)
"""The part of a GID that is the same for all endpoints of a participant. A process with ROS 2 has one for each context."""


@lru_cache(maxsize=1024)
def host_id(*ips: str) -> bytes:
    """Return the two bytes of a GID for a host with these IPv4 addresses, in the order of its interfaces.

    Raises ValueError if one is not an IPv4 address; Fast DDS leaves IPv6 out.
    """
    digest = hashlib.md5(usedforsecurity=False)
    for ip in ips:
        digest.update(bytes(12) + ipaddress.IPv4Address(ip).packed)
    folded = bytearray(2)
    for i, byte in enumerate(digest.digest()):
        folded[1 - i % 2] ^= byte
    return bytes(folded)
