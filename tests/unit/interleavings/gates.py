"""The gate objects in a run, of whichever kind."""

from __future__ import annotations

from collections.abc import Iterator

from tests.unit.interleavings.apiserver import ApiServer
from understudy.api import names
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord

NAMESPACE = "fleet"

KINDS: dict[str, GateKind] = {kind.resource.plural: kind for kind in registry.KINDS.values()}
"""By the plural of their objects."""

_KINDS = {kind.object_kind: kind for kind in registry.KINDS.values()}


def is_gate(plural: str, item: Object) -> bool:
    """Whether an object is a gate."""
    return plural in KINDS and item["metadata"]["name"].endswith("-gate")


def place(server: ApiServer, workload: str) -> tuple[str, Object] | None:
    """The gate of a workload and its plural; None if there is none."""
    for plural in KINDS:
        if (gate := server.get(plural, (NAMESPACE, names.gate(workload)))) is not None:
            return plural, gate
    return None


def find(server: ApiServer, workload: str) -> Object | None:
    """The gate of a workload; None if there is none."""
    found = place(server, workload)
    return found[1] if found is not None else None


def record(server: ApiServer, workload: str) -> GateRecord | None:
    """The record of a workload's gate."""
    gate = find(server, workload)
    return GateRecord.of(gate) if gate is not None else None


def everyone(server: ApiServer) -> Iterator[tuple[str, Object]]:
    """All gates, each with its workload."""
    for plural in KINDS:
        for item in server.items[plural].values():
            if is_gate(plural, item):
                yield item["metadata"]["name"].removesuffix("-gate"), item


def kind_of(gate: Object) -> GateKind:
    """The kind of a gate object."""
    return _KINDS[gate["kind"]]


def let_through(gate: Object) -> tuple[str, ...]:
    """The instances that a gate lets through."""
    return kind_of(gate).let_through(gate)
