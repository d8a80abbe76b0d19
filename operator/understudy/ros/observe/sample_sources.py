"""Attributes samples to pods.

A pod has one address, the cluster knows it, and the GID of a writer identifies its host. Two pods can have the same
host id in GIDs. That is reported and never guessed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from understudy.ros.rmw import MIDDLEWARE

_NAMED = b"pod "
"""The beginning of a key that has the name of a pod. No GID begins with it: Fast DDS is vendor 1.15."""


def named(pod: str) -> bytes:
    """Return the key of a pod whose samples are recognized by their writers, for which its address does not matter."""
    return _NAMED + pod.encode()


class Sources:
    """The pods that may have sent a sample."""

    def __init__(self, instances: Mapping[str, str]) -> None:
        """``instances`` has the IP of each pod.

        Pods without one (yet), or with an IPv6 address, cannot be identified by it.
        """
        self.instances = dict(instances)
        self.unknown: list[str] = []
        """Pods that no sample can be attributed to."""
        pods: dict[bytes, list[str]] = {}
        for pod, ip in instances.items():
            try:
                pods.setdefault(MIDDLEWARE.host_at(ip), []).append(pod)
            except ValueError:
                self.unknown.append(pod)
        self._pods = {host: tuple(sorted(names)) for host, names in pods.items()}

    def candidates(self, gid: bytes) -> tuple[str, ...]:
        """Return the pods that may contain the writer with this GID (its HOST part is enough, or the key of a pod); empty if none can."""
        if gid.startswith(_NAMED):
            return (gid[len(_NAMED) :].decode(),)
        return self._pods.get(MIDDLEWARE.host_of(gid), ())

    def pod(self, gid: bytes) -> str | None:
        """Return the pod that contains the writer with this GID.

        None if it is in none of the pods, or may be in more than one.
        """
        names = self.candidates(gid)
        return names[0] if len(names) == 1 else None

    @property
    def ambiguous(self) -> list[tuple[str, ...]]:
        """Groups of pods that cannot be distinguished."""
        return [names for names in self._pods.values() if len(names) > 1]

    def problems(self) -> Iterable[str]:
        """Yield messages for users about pods that cannot be identified or distinguished. A pod without an address has not begun."""
        for name in self.unknown:
            if ip := self.instances[name]:
                yield (
                    f"The messages of {name} ({ip}) cannot be recognized: {MIDDLEWARE.name} identifies hosts by their IPv4 addresses. "
                    "Use a cluster where the first address of each pod is an IPv4 address."
                )
        for names in self.ambiguous:
            addresses = ", ".join(f"{name} ({self.instances[name]})" for name in names)
            if len({self.instances[name] for name in names}) == 1:
                yield f"The messages of {addresses} cannot be distinguished: these pods had the same address, one after the other."
            else:
                yield (
                    f"The messages of {addresses} cannot be distinguished: {MIDDLEWARE.name} gives their addresses the same host id. "
                    "Delete the standby: its replacement gets another address."
                )
