"""Nodes that are to be emptied, while the instance in control of a robot runs on one of them.

Evictions of that instance wait, by a PodDisruptionBudget, until its monitor has handed over to an understudy on another node, or until
they have waited for as long as the workload says. The operator sees the nodes and tells the monitor, whose rights stay small.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.conditions import Condition, condition
from understudy.api.switchovers import Drain, Draining
from understudy.cluster.client import Object
from understudy.controller import evictions, nodes, objects

CONDITION = "Draining"


def seen(active: Object | None, cordoned: Collection[str], present: Drain | None, now: float) -> Drain | None:
    """What a monitor is told of the node of its instance in control; ``present`` is what it was told last."""
    if active is None or (node := nodes.of(active)) not in cordoned:
        return None
    uid = objects.uid(active)
    since = present.since if present is not None and (present.uid, present.node) == (uid, node) else round(now, 3)
    return Drain(uid=uid, node=node, since=since, cordoned=sorted(cordoned))


@dataclass(frozen=True)
class Hold:
    """Whether evictions of the instance in control wait."""

    reason: str
    message: str
    holds: bool = False
    until: float | None = None
    """When they no longer do, in unix seconds; None while nothing is drained."""


def hold(
    active: Object | None,
    drain: Drain | None,
    asked: Draining,
    *,
    fallbacks: bool,
    budgets: Sequence[Object],
    now: float,
) -> Hold:
    """Whether evictions of the instance in control wait, and else why not.

    ``fallbacks`` is whether any understudy could come before it goes; ``budgets`` are those of others in the namespace.
    """
    if active is None:
        return Hold("NoneInControl", "no instance is in control")
    length = seconds(asked.hold_for)
    if not length:
        return Hold("NotAskedFor", "spec.draining.holdFor is 0s")
    if not fallbacks:
        return Hold(
            "NoFallback", "its policy has no Fallback whose pool serves it, so nothing could take over before it goes"
        )
    if other := next((objects.name(b) for b in budgets if evictions.selects(b, objects.labels(active))), None):
        # With two of them Kubernetes refuses every eviction, for good.
        return Hold(
            "OtherBudget", f"PodDisruptionBudget {other}, which isn't of Understudy, selects it and decides alone"
        )
    if drain is None:
        return Hold("Held", "", holds=True)
    until = drain.since + length
    if now >= until:
        words = f"no understudy on another node took over within {asked.hold_for}; see status.switchover for what it waited for"
        return Hold("HoldEnded", words)
    return Hold("Held", "", holds=True, until=until)


def budget(workload: str, active: Object) -> Object:
    """The budget by which an eviction of the instance in control is refused for now (429), as whoever drains tries again.

    An instance that isn't ready doesn't wait: what isn't well fails over anyway.
    """
    chosen = {names.WORKLOAD: workload, names.INSTANCE: objects.name(active)}
    return evictions.keeping(names.in_control(workload), 1, chosen)


def said(active: Object, drain: Drain, found: Hold, generation: int | None) -> Condition:
    """The condition that tells of it, while a node is drained."""
    told = f"Node {drain.node}, from which {objects.name(active)} drives the robot, is to be emptied (it is cordoned)."
    if not found.holds:
        then = f"Evictions of it don't wait: {found.message}."
        return condition(CONDITION, False, found.reason, f"{told} {then}", generation=generation)
    clock = datetime.fromtimestamp(found.until or 0.0, UTC).strftime("%H:%M:%S UTC")
    then = f"Evictions of it wait for an understudy on another node to take over, until {clock} at the latest."
    return condition(CONDITION, True, found.reason, f"{told} {then}", generation=generation)
