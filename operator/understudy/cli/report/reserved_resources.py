"""Sums the resource requests of the pods of robots and pools, by role and by strategy. Pure.

Requests are what the scheduler uses, so strategies can be compared in any cluster. Usage would need a metrics API.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from understudy.api import names
from understudy.api.quantities import amount
from understudy.cli.common.robots import Robot
from understudy.kube import claims

ROLES = {
    "control": "active instance",
    "standby": "standbys",
    "monitor": "monitor",
    "discovery": "discovery server",
    "pool": "waiting in a pool",
}
"""Roles of pods and their labels."""


class Amounts(NamedTuple):
    """Amounts of CPU and memory."""

    cpu: float = 0.0
    """Cores."""
    memory: float = 0.0
    """Bytes."""

    def plus(self, other: Amounts) -> Amounts:
        """Return the sum."""
        return Amounts(self.cpu + other.cpu, self.memory + other.memory)

    def over(self, count: int) -> Amounts:
        """Return the mean over ``count``."""
        return Amounts(self.cpu / count, self.memory / count)


@dataclass(frozen=True)
class Share:
    """The mean reservation per robot for one current strategy, or that of a pool with all of its pods."""

    name: str
    count: int
    """Number of robots in the mean, or number of waiting pods."""
    roles: Mapping[str, Amounts] = field(default_factory=dict)

    @property
    def total(self) -> Amounts:
        """The sum over all roles."""
        return _sum(self.roles.values())


def shares(robots: Sequence[Robot], pods: Iterable[Mapping[str, Any]]) -> list[Share]:
    """Return the reservations by strategy, then by pool."""
    by_robot: dict[tuple[str, str], dict[str, Amounts]] = {}
    pools: dict[tuple[str, str], list[Amounts]] = {}
    active = {(robot.namespace, robot.active) for robot in robots}
    for pod in pods:
        metadata = pod["metadata"]
        labels, namespace = metadata.get("labels") or {}, metadata["namespace"]
        if metadata.get("deletionTimestamp") or pod.get("status", {}).get("phase") in ("Succeeded", "Failed"):
            continue
        whose: str | None
        if whose := claims.workload_of(labels):
            role = "control" if (namespace, metadata["name"]) in active else "standby"
        elif whose := labels.get(names.MONITORED):
            role = "monitor" if labels.get(names.COMPONENT) == "monitor" else "discovery"
        elif pool := labels.get(names.POOL):
            pools.setdefault((namespace, pool), []).append(requested(pod["spec"]))
            continue
        else:
            continue
        mine = by_robot.setdefault((namespace, whose), {})
        mine[role] = mine.get(role, Amounts()).plus(requested(pod["spec"]))
    groups: dict[str, list[Mapping[str, Amounts]]] = {}
    for robot in robots:
        groups.setdefault(robot.strategy or "none", []).append(by_robot.get((robot.namespace, robot.name), {}))
    several = len({robot.namespace for robot in robots}) > 1
    return [
        *(Share(name, len(found), _mean(found)) for name, found in sorted(groups.items())),
        *(
            Share(f"pool {f'{namespace}/' if several else ''}{name}", len(found), {"pool": _sum(found)})
            for (namespace, name), found in sorted(pools.items())
        ),
    ]


def requested(spec: Mapping[str, Any]) -> Amounts:
    """Return the requests of a running pod: containers, sidecar init containers, and overhead."""
    return _sum(_requests(spec))


def _requests(spec: Mapping[str, Any]) -> Iterator[Amounts]:
    lasting = [c for c in spec.get("initContainers") or [] if c.get("restartPolicy") == "Always"]
    for container in (*spec.get("containers", ()), *lasting):
        yield _amounts((container.get("resources") or {}).get("requests") or {})
    yield _amounts(spec.get("overhead") or {})


def _amounts(found: Mapping[str, str]) -> Amounts:
    return Amounts(*(float(amount(str(found.get(key, "0")))) for key in ("cpu", "memory")))


def _sum(found: Iterable[Amounts]) -> Amounts:
    total = Amounts()
    for one in found:
        total = total.plus(one)
    return total


def _mean(found: Sequence[Mapping[str, Amounts]]) -> dict[str, Amounts]:
    return {role: _sum(one.get(role, Amounts()) for one in found).over(len(found)) for role in ROLES}
