"""Decides when a monitor is replaced on another node: the loss of one node must not end the active instance and its monitor.

The scheduler prefers nodes without the workload's instances, but it never moves a pod, and the active instance changes with each failover.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from understudy.api import names
from understudy.controller.desired.discovery_server import TOLERATIONS
from understudy.controller.observed import kube_objects, leaving_nodes, policy_reader
from understudy.controller.observed.observation import Observed
from understudy.kube.client import DEPLOYMENTS, Object

SETTLED_SECONDS = 600.0
"""Seconds after a failure, and after the monitor's start, for which it stays. Soon after a failure the next one is likeliest."""


@dataclass(frozen=True)
class Placement:
    """Which instance's node a monitor avoids."""

    apart_from: str = ""
    """Name of the instance; empty if there is none. A change replaces the monitor's pod."""
    again_after: float | None = None
    """Seconds until this may have changed although nothing reports it."""


def placement(observed: Observed) -> Placement:
    """Return whose node the monitor avoids: the active instance's if it must move, else the same instance's as before."""
    before = _before(observed)
    active = observed.active
    if active is None or not leaving_nodes.of(active) or kube_objects.name(active) == before:
        return Placement(before)
    place = leaving_nodes.of(active)
    monitors = [pod for pod in observed.monitors if kube_objects.ready(pod)]
    if place in observed.leaving or not monitors or not all(leaving_nodes.of(pod) == place for pod in monitors):
        return Placement(before)
    if not leaving_nodes.another_accepts(observed.nodes, place, TOLERATIONS):
        return Placement(before)
    healthy = (observed.workload.get("status") or {}).get("health") == "Healthy"
    if not healthy or observed.recovering or observed.handing_over or _would_lose_recordings(observed):
        return Placement(before)
    changed = max(_last_failure(observed.workload), *map(kube_objects.created, monitors))
    rest = observed.left(SETTLED_SECONDS, since=changed)
    return Placement(before, rest) if rest > 0.0 else Placement(kube_objects.name(active))


def _before(observed: Observed) -> str:
    live = observed.owned.get((DEPLOYMENTS.plural, names.monitor(kube_objects.name(observed.workload))))
    spec = ((live or {}).get("spec") or {}).get("template", {}).get("spec") or {}
    apart = (spec.get("affinity") or {}).get("podAntiAffinity") or {}
    terms = apart.get("preferredDuringSchedulingIgnoredDuringExecution") or []
    found = (term["podAffinityTerm"]["labelSelector"]["matchLabels"].get(names.INSTANCE) for term in terms)
    return next((name for name in found if name), "")


def _would_lose_recordings(observed: Observed) -> bool:
    """Whether recordings are in the volume of the monitor's pod, and are lost with it."""
    if observed.policy is None or policy_reader.problem(observed.policy, observed.config_maps) is not None:
        return True
    spec = policy_reader.spec(observed.policy)
    return spec.black_box is not None and not spec.state.storage.claim_name


def _last_failure(workload: Object) -> float:
    found = (workload.get("status") or {}).get("recoveries") or []
    detected = ((one.get("moments") or {}).get("detected") for one in found)
    return max((datetime.fromisoformat(text).timestamp() for text in detected if text), default=0.0)
