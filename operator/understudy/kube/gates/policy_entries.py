"""How many entries a network engine needs that keeps one for each peer and each block of ports, such as Cilium."""

from __future__ import annotations

from collections import Counter
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


class Peers:
    """All peers of a cluster, by namespace: most rules select in one namespace, and a cluster may have thousands of peers."""

    def __init__(self, peers: Iterable[Peer]) -> None:
        self._groups: dict[str, dict[frozenset[tuple[str, str]], list[tuple[int, Mapping[str, str]]]]] = {}
        """By the name of a namespace and its labels: the number and the labels of each peer."""
        for number, peer in enumerate(peers):
            groups = self._groups.setdefault(peer.namespace, {})
            groups.setdefault(frozenset(peer.namespace_labels.items()), []).append((number, peer.labels))

    def selected(self, selector: Object, namespace: str) -> Iterator[int]:
        """Yield the numbers of the peers that an entry of ``from`` or ``to`` selects in a policy of this namespace."""
        if "ipBlock" in selector:
            return
        of_namespace, of_pod = selector.get("namespaceSelector"), selector.get("podSelector") or {}
        for groups in [self._groups.get(namespace, {})] if of_namespace is None else self._groups.values():
            for namespace_labels, peers in groups.items():
                if of_namespace is None or selectors.matches(of_namespace, dict(namespace_labels)):
                    yield from (number for number, labels in peers if selectors.matches(of_pod, labels))


def needed_for_each(policies: Iterable[Object], peers: Peers, namespace: str) -> list[int]:
    """Return, for each peer that counts, the entries of a pod that these NetworkPolicies of a namespace select."""
    found: Counter[int] = Counter()
    for selected, ports in _rules(policies):
        entries = _entries(ports)
        for peer in {number for one in selected for number in peers.selected(one, namespace)}:
            found[peer] += entries
    return list(found.values())


def _rules(policies: Iterable[Object]) -> Iterator[tuple[Sequence[Object], Sequence[Object]]]:
    """Yield the peers and the ports of each rule. A rule for everybody has the same entries however many peers there are."""
    for policy in policies:
        for side, key in (("egress", "to"), ("ingress", "from")):
            for rule in policy["spec"].get(side) or []:
                if rule.get(key):
                    yield rule[key], rule.get("ports") or [{}]


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
