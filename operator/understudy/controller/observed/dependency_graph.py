"""Dependencies between workloads: whether they are valid, and everything that a workload depends on, in order.

These functions use names alone, so that they can check files as well as objects.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence

from understudy.api.conditions import Condition, condition
from understudy.api.protocol.monitor_settings import Upstream
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Problem
from understudy.kube.client import Object

RESOLVED = "DependenciesResolved"
"""The condition that reports whether a workload's dependencies are used."""

Graph = Mapping[str, Sequence[str]]
"""The dependencies of each workload, by name."""


def named(workload: Object) -> list[str]:
    """Return the names of the workloads that a workload depends on, in order, as far as its spec can be read."""
    spec = workload.get("spec")
    entries = spec.get("dependsOn") if isinstance(spec, Mapping) else None
    found = [one.get("name") for one in entries if isinstance(one, Mapping)] if isinstance(entries, list) else []
    return list(dict.fromkeys(name for name in found if isinstance(name, str) and name))


def graph(workloads: Iterable[Object]) -> dict[str, list[str]]:
    """Return the dependencies of each workload of a namespace, without workloads that are being deleted."""
    return {kube_objects.name(one): named(one) for one in workloads if not kube_objects.deleted(one)}


def circle(known: Graph, name: str) -> list[str] | None:
    """Return a shortest path from a workload over its dependencies back to itself, such as ``[a, b, a]``, or None.

    It starts with the alphabetically first name, so that it is the same for each of its members.
    """
    before: dict[str, str] = {}
    queue = deque([name])
    while queue:
        at = queue.popleft()
        for following in known.get(at, ()):
            if following == name:
                way = [at]
                while way[-1] != name:
                    way.append(before[way[-1]])
                way.reverse()
                first = way.index(min(way))
                return [*way[first:], *way[:first], way[first]]
            if following not in before:
                before[following] = at
                queue.append(following)
    return None


def upstream(known: Graph, name: str) -> list[Upstream]:
    """Return all direct and indirect dependencies of a workload, each after its own; empty if there is a cycle."""
    if first_circle(known, name) is not None:
        return []
    left = [one for one in _reached(known, name) if one != name]
    order: list[str] = []
    while left:
        order += [one for one in left if all(before in order for before in known.get(one, ()))]
        left = [one for one in left if one not in order]
    return [Upstream(name=one, depends_on=list(known.get(one, ()))) for one in order]


def first_circle(known: Graph, name: str) -> list[str] | None:
    """Return the cycle that contains a workload, or else a cycle among its dependencies; None if there is none."""
    return next((found for one in _reached(known, name) if (found := circle(known, one)) is not None), None)


def _reached(known: Graph, name: str) -> Iterator[str]:
    """Yield a workload and all its dependencies, the nearest first."""
    visited, queue = {name}, deque([name])
    while queue:
        at = queue.popleft()
        yield at
        for following in known.get(at, ()):
            if following not in visited:
                visited.add(following)
                queue.append(following)


def drawn(found: Sequence[str]) -> str:
    """Return a cycle as text."""
    return " -> ".join(found)


def problem(known: Graph, name: str, namespace: str) -> Problem | None:
    """Return why some or all of a workload's dependencies are not used, or None."""
    found = first_circle(known, name)
    if found is not None:
        where = "" if name in found else f"{name} depends on a cycle: "
        if len(found) == 2:
            what = f"{found[0]} depends on itself ({drawn(found)})"
        else:
            what = f"{drawn(found)} is a cycle, so no workload in it can be recovered first"
        return Problem(
            "DependencyCycle",
            f"spec.dependsOn: {where}{what}. Remove one of these dependencies. Until then each of them is protected as if it "
            f"had no dependency",
        )
    missing = [one for one in known.get(name, ()) if one not in known]
    if missing:
        others = [one for one in known if one != name]
        return Problem(
            "DependencyNotFound",
            f'spec.dependsOn: no RobotWorkload "{missing[0]}" in namespace {namespace} ({kube_objects.hint(missing[0], others)}). '
            f"Create it or correct the name; until then, Understudy ignores this dependency of {name}",
        )
    return None


def resolved(known: Graph, workload: Object) -> list[Condition]:
    """Return the condition for a workload's dependencies; empty if it has none."""
    name = kube_objects.name(workload)
    if not known.get(name):
        return []
    found = problem(known, name, workload["metadata"]["namespace"])
    if found is not None:
        return [condition(RESOLVED, False, found.reason, f"{found.message}.")]
    order = ", ".join(one.name for one in upstream(known, name))
    message = f"This workload depends on {order}. If several of these are recovered, its onRecovery procedures run in this order."
    return [condition(RESOLVED, True, "Resolved", message)]
