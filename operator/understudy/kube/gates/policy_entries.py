"""How many entries a network engine needs that keeps one for each peer and each block of ports, such as Cilium."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from understudy.kube import selectors
from understudy.kube.client import Object


@dataclass(frozen=True)
class Peer:
    """Pods that the engine does not distinguish, because they have the same labels and the same namespace."""

    namespace: str
    labels: Mapping[str, str]
    namespace_labels: Mapping[str, str]


def needed_for_each(policies: Iterable[Object], peers: Sequence[Peer], namespace: str) -> list[int]:
    """Return, for each peer, the entries of a pod that these NetworkPolicies of a namespace select."""
    rules = [(selected, _entries(ports)) for selected, ports in _rules(policies)]
    return [
        sum(entries for selected, entries in rules if any(_selects(one, peer, namespace) for one in selected))
        for peer in peers
    ]


def _rules(policies: Iterable[Object]) -> Iterator[tuple[Sequence[Object], Sequence[Object]]]:
    """Yield the peers and the ports of each rule. A rule for everybody has the same entries however many peers there are."""
    for policy in policies:
        for side, key in (("egress", "to"), ("ingress", "from")):
            for rule in policy["spec"].get(side) or []:
                if rule.get(key):
                    yield rule[key], rule.get("ports") or [{}]


def _selects(selector: Object, peer: Peer, namespace: str) -> bool:
    if "ipBlock" in selector:
        return False
    if (of_namespace := selector.get("namespaceSelector")) is None:
        is_there = peer.namespace == namespace
    else:
        is_there = selectors.matches(of_namespace, peer.namespace_labels)
    return is_there and selectors.matches(selector.get("podSelector") or {}, peer.labels)


def _entries(ports: Sequence[Object]) -> int:
    return sum(map(_blocks_of, ports))


def _blocks_of(port: Object) -> int:
    first = port.get("port")
    return blocks(first, int(port.get("endPort", first))) if isinstance(first, int) else 1


def blocks(first: int, last: int) -> int:
    """Return into how many blocks a range of ports is divided that are powers of two and begin at a multiple of their size."""
    found = 0
    while first <= last:
        size = first & -first or 1 << 16
        while first + size - 1 > last:
            size //= 2
        first, found = first + size, found + 1
    return found
