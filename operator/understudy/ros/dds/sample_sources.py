"""Which pod sent a sample.

Fast DDS begins every GUID with its vendor's id and a 16-bit id of the host, which it derives from the IPv4 addresses of
the host's interfaces, loopback excluded (``Host`` in its ``utils``). A pod has one address, the cluster knows it, and
so a writer's GID tells its pod. Sixteen bits can be the same for two pods: that is said, never guessed at.
"""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Iterable, Mapping
from functools import lru_cache

VENDOR = bytes([0x01, 0x0F])
"""How a GID of Fast DDS begins; the host's id follows."""

HOST = slice(0, 4)
"""The part of a GID that is the same for all writers of a host: the vendor and the host's id."""


@lru_cache(maxsize=1024)
def host_id(*ips: str) -> bytes:
    """The two bytes of a GID for a host with these IPv4 addresses, in the order of its interfaces.

    Raises ValueError when one is no IPv4 address; Fast DDS leaves IPv6 out.
    """
    digest = hashlib.md5(usedforsecurity=False)
    for ip in ips:
        digest.update(bytes(12) + ipaddress.IPv4Address(ip).packed)
    folded = bytearray(2)
    for i, byte in enumerate(digest.digest()):
        folded[1 - i % 2] ^= byte
    return bytes(folded)


class Sources:
    """The pods that may have sent a sample."""

    def __init__(self, instances: Mapping[str, str]) -> None:
        """``instances`` has the IP of each pod; those without one (yet), or with an IPv6 one, can't be told."""
        self.instances = dict(instances)
        self.unknown: list[str] = []
        """Pods that no sample can be attributed to."""
        pods: dict[bytes, list[str]] = {}
        for pod, ip in instances.items():
            try:
                pods.setdefault(VENDOR + host_id(ip), []).append(pod)
            except ValueError:
                self.unknown.append(pod)
        self._pods = {host: tuple(sorted(names)) for host, names in pods.items()}

    def candidates(self, gid: bytes) -> tuple[str, ...]:
        """The pods that the writer with this GID (its HOST part is enough) may be in; empty for none of them."""
        return self._pods.get(gid[HOST], ())

    def pod(self, gid: bytes) -> str | None:
        """The pod that the writer with this GID is in; None where it's none of them, or may be more than one."""
        names = self.candidates(gid)
        return names[0] if len(names) == 1 else None

    @property
    def ambiguous(self) -> list[tuple[str, ...]]:
        """Groups of pods that can't be told apart."""
        return [names for names in self._pods.values() if len(names) > 1]

    def problems(self) -> Iterable[str]:
        """What a user should know about pods that can't be told (apart), in plain words."""
        for names in self.ambiguous:
            addresses = ", ".join(f"{name} ({self.instances[name]})" for name in names)
            if len({self.instances[name] for name in names}) == 1:
                yield f"{addresses} can't be told apart: they have the same address, one after the other."
            else:
                yield (
                    f"{addresses} can't be told apart: Fast DDS gives their addresses the same 16-bit host id. Delete "
                    "the standby among them, its replacement gets another address."
                )
