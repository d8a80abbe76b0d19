"""What Cilium's limits mean for gates: the room in its policy maps, and robots in the network of a node.

Each pod has a policy map, with entries for each set of labels among its peers. Beyond the size of that map, Cilium changes nothing any more
and reports nothing. docs/how-to/network-policies.md has the figures. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_network

from understudy.api import names
from understudy.kube.client import Object, Resource
from understudy.kube.gates.policy_entries import Peer, Peers, needed_for_each

IDENTITIES = Resource("cilium.io", "v2", "ciliumidentities")
SYSTEM, SETTINGS = "kube-system", "cilium-config"
"""Namespace and name of the ConfigMap with Cilium's settings."""

ENTRIES = 16384
"""Entries of the policy map of a pod, unless ``bpf-policy-map-max`` is set."""

FULL = 0.7
"""Share of the entries above which a warning is due: identities that nobody uses any more count for up to half an hour."""

PAGE = "docs/how-to/network-policies.md#cilium"

MORE_ROOM = (
    "let spec.gate.peers select the robot's pods only, put robots into namespaces of their own, or set bpf-policy-map-max (65536 at "
    f"most) in ConfigMap {SETTINGS}: {PAGE}"
)
"""What helps if a policy map has too little room."""

_SIZE, _CLOSES, _MODE = "bpf-policy-map-max", "enable-endpoint-lockdown-on-policy-overflow", "policy-cidr-match-mode"
_PREFIX, _NAMESPACE = "k8s:", "k8s:io.kubernetes.pod.namespace"

OF_NAMESPACE = "k8s:io.cilium.k8s.namespace.labels."
"""How labels of an identity begin that are those of its namespace."""

_MOST_QUOTED = 40


@dataclass(frozen=True)
class Settings:
    """The settings of Cilium that matter for gates."""

    entries: int = ENTRIES
    """Entries of each policy map."""
    doubt: str = ""
    """Why the number of entries is only assumed; empty if it is known."""
    closes: bool = False
    """Whether Cilium closes a pod whose policy map is too small."""
    matches_nodes: bool = False
    """Whether address blocks match the addresses of nodes."""

    @classmethod
    def of(cls, data: Mapping[str, str]) -> Settings:
        """Read the data of Cilium's ConfigMap."""
        size, doubt = data.get(_SIZE, str(ENTRIES)), ""
        if not (size.isascii() and size.isdigit() and int(size)):
            doubt = (
                f"{_SIZE} in ConfigMap {SYSTEM}/{SETTINGS} is {size[:_MOST_QUOTED]!r}, which is no whole number above 0"
            )
        return cls(
            entries=ENTRIES if doubt else int(size),
            doubt=doubt,
            closes=data.get(_CLOSES, "false") == "true",
            matches_nodes="nodes" in data.get(_MODE, ""),
        )


UNREADABLE = Settings(doubt=f"ConfigMap {SYSTEM}/{SETTINGS} cannot be read")
"""The settings that are assumed if the ConfigMap cannot be read."""


@dataclass(frozen=True)
class PolicyMapUse:
    """How much of the policy map of an instance the gate of a workload needs."""

    needed: int
    """Entries for all peers."""
    each: int
    """Entries for each further pod of the peers."""
    settings: Settings

    @property
    def share(self) -> float:
        """Return the share of the entries that are needed; above 1 beyond the limit."""
        return self.needed / self.settings.entries

    @property
    def percent(self) -> int:
        """Return the same in percent, rounded up."""
        return math.ceil(100 * self.needed / self.settings.entries)

    @property
    def is_low(self) -> bool:
        """Whether so much is needed that a warning is due."""
        return self.needed > FULL * self.settings.entries

    @property
    def is_exceeded(self) -> bool:
        """Whether more entries are needed than there are."""
        return self.needed > self.settings.entries

    @property
    def consequence(self) -> str:
        """Return what Cilium does beyond the limit."""
        if self.settings.closes:
            return "Cilium closes the gate of everybody"
        return "Cilium no longer enforces changes, so several instances may drive a robot"


def policy_map_use(
    workload: str, namespace: str, policies: Mapping[str, Object], peers: Peers, settings: Settings
) -> PolicyMapUse | None:
    """Return what the policies of a workload need, which are among those of its namespace by name; None if they need nothing."""
    own = (names.standby(workload), names.standby_reference(workload), names.gate(workload))
    entries = needed_for_each([policies[one] for one in own if one in policies], peers, namespace)
    return PolicyMapUse(sum(entries), max(entries), settings) if entries else None


def peer(identity: Object) -> Peer:
    """Return the pods of a CiliumIdentity."""
    labels: Mapping[str, str] = identity.get("security-labels") or {}
    own = {key: value for key, value in labels.items() if key != _NAMESPACE and not key.startswith("k8s:io.cilium.")}
    return Peer(
        labels.get(_NAMESPACE, ""),
        {key.removeprefix(_PREFIX): value for key, value in own.items()},
        {key.removeprefix(OF_NAMESPACE): value for key, value in labels.items() if key.startswith(OF_NAMESPACE)},
    )


def at_nodes(robots: Iterable[object], nodes: Iterable[Object]) -> Iterator[tuple[str, str]]:
    """Yield the addresses of nodes that ``spec.gate.robots`` includes, each with the name of its node."""
    networks = [network for one in robots if (network := _network(one)) is not None]
    for node in nodes:
        for found in (node.get("status") or {}).get("addresses") or []:
            address = _network(found.get("address")) if found.get("type") == "InternalIP" else None
            if address is not None and any(address.network_address in network for network in networks):
                yield found["address"], node["metadata"]["name"]


def _network(text: object) -> IPv4Network | IPv6Network | None:
    """Return an address or an address block; None if it is neither."""
    try:
        return ip_network(text, strict=False) if isinstance(text, str) else None
    except ValueError:
        return None
