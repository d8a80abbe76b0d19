"""Placement of Understudy's pods: apart from pods that should not be lost with them, and soon away from lost nodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api import names
from understudy.kube.client import Object

LOST_SECONDS = 30

_HOSTNAME = "kubernetes.io/hostname"
MOST = 100  # the maximum weight: an understudy on the node of the active pod is lost with it
_DISTANCE_OF_MONITOR = 50  # a monitor lost with the active pod must first start elsewhere, which takes seconds


def keep_apart(spec: Object, *, workload: str, pool: str, held: bool) -> None:
    """Prefer nodes without other instances (of the workload, or of the shared pool), then nodes without the monitor.

    If the template of a shared pool sets a placement, that placement is kept.
    """
    if held and places_itself({"spec": spec}):
        return
    labels = {names.WORKLOAD: workload} if workload else {names.POOL: pool}
    terms = [away_from(labels, MOST)]
    if workload:
        terms.append(away_from({names.MONITORED: workload}, _DISTANCE_OF_MONITOR))
    affinity = dict(spec.get("affinity") or {})
    apart = dict(affinity.get("podAntiAffinity") or {})
    key = "preferredDuringSchedulingIgnoredDuringExecution"
    apart[key] = [*(apart.get(key) or []), *terms]
    spec["affinity"] = {**affinity, "podAntiAffinity": apart}
    _spread(spec, labels)


def _spread(spec: Object, labels: Mapping[str, str]) -> None:
    """Add a constraint with which the scheduler counts the other pods on each node, except those being deleted.

    An affinity counts these too: with two nodes, of which one has the failed pod, the next understudy might be placed
    beside the active one. The API server accepts one constraint for each pair of these two fields.
    """
    ours = {
        "maxSkew": 1,
        "topologyKey": _HOSTNAME,
        "whenUnsatisfiable": "ScheduleAnyway",
        "labelSelector": {"matchLabels": dict(labels)},
    }
    constraints = spec.get("topologySpreadConstraints") or []
    if not any(
        (one.get("topologyKey"), one.get("whenUnsatisfiable")) == (_HOSTNAME, "ScheduleAnyway") for one in constraints
    ):
        spec["topologySpreadConstraints"] = [*constraints, ours]


def away_from(labels: Mapping[str, str], weight: int) -> Object:
    """Return a preference for nodes without such pods. Its weight (1 to 100) is relative to other preferences."""
    term = {"topologyKey": _HOSTNAME, "labelSelector": {"matchLabels": dict(labels)}}
    return {"weight": weight, "podAffinityTerm": term}


def places_itself(template: Mapping[str, Any]) -> bool:
    """Whether a template has its own rules for how its pods are spread."""
    spec = template.get("spec") or {}
    return bool(spec.get("topologySpreadConstraints") or (spec.get("affinity") or {}).get("podAntiAffinity"))


def apart_from(pod: Object, instance: str) -> Object:
    """Return a pod that the scheduler does not place on the node of an instance, even if no other node has room."""
    affinity = pod["spec"].get("affinity") or {}
    apart = affinity.get("podAntiAffinity") or {}
    key = "requiredDuringSchedulingIgnoredDuringExecution"
    term = {"topologyKey": _HOSTNAME, "labelSelector": {"matchLabels": {names.INSTANCE: instance}}}
    apart = {**apart, key: [*(apart.get(key) or []), term]}
    return {**pod, "spec": {**pod["spec"], "affinity": {**affinity, "podAntiAffinity": apart}}}


def leave_lost_nodes(spec: Object) -> None:
    """Replace a pod on a lost node after LOST_SECONDS, instead of Kubernetes' five minutes without an understudy."""
    tolerations = spec.get("tolerations") or []
    spec["tolerations"] = [
        *tolerations,
        *(
            {"key": key, "operator": "Exists", "effect": "NoExecute", "tolerationSeconds": LOST_SECONDS}
            for key in ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
            if not any(_tolerates(toleration, key) for toleration in tolerations)
        ),
    ]


def _tolerates(toleration: Mapping[str, Any], key: str) -> bool:
    return toleration.get("key") in (key, None) and toleration.get("effect") in ("NoExecute", None)
