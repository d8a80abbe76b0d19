"""On which nodes our pods are to be: away from those with which they would be lost, and off lost ones soon."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api import names
from understudy.kube.client import Object

LOST_SECONDS = 30

_HOSTNAME = "kubernetes.io/hostname"
_DISTANCE = 100  # the greatest weight: an understudy on the node of the active pod dies with it
_DISTANCE_OF_MONITOR = 50  # a monitor that dies with the active pod is started elsewhere first, which takes seconds


def keep_apart(spec: Object, *, workload: str, pool: str, held: bool) -> None:
    """Prefer other nodes than those of the other instances (of the workload, or of the shared pool), then than the monitor's.

    Where a shared pool's pods are to be is left to its template, if that says so.
    """
    if held and (spec.get("topologySpreadConstraints") or (spec.get("affinity") or {}).get("podAntiAffinity")):
        return
    labels = {names.WORKLOAD: workload} if workload else {names.POOL: pool}
    terms = [away_from(labels, _DISTANCE)]
    if workload:
        terms.append(away_from({names.MONITORED: workload}, _DISTANCE_OF_MONITOR))
    affinity = dict(spec.get("affinity") or {})
    apart = dict(affinity.get("podAntiAffinity") or {})
    key = "preferredDuringSchedulingIgnoredDuringExecution"
    apart[key] = [*(apart.get(key) or []), *terms]
    spec["affinity"] = {**affinity, "podAntiAffinity": apart}
    _spread(spec, labels)


def _spread(spec: Object, labels: Mapping[str, str]) -> None:
    """Have the scheduler count the others on each node, without those that are on their way out.

    For an affinity they are as good as there: with two nodes, of which one has the pod that failed, the next understudy would as soon be
    beside the one in control. The API server takes one constraint for each pair of these two fields.
    """
    ours = {
        "maxSkew": 1,
        "topologyKey": _HOSTNAME,
        "whenUnsatisfiable": "ScheduleAnyway",
        "labelSelector": {"matchLabels": dict(labels)},
    }
    given = spec.get("topologySpreadConstraints") or []
    if not any(
        (one.get("topologyKey"), one.get("whenUnsatisfiable")) == (_HOSTNAME, "ScheduleAnyway") for one in given
    ):
        spec["topologySpreadConstraints"] = [*given, ours]


def away_from(labels: Mapping[str, str], weight: int) -> Object:
    """A preference for nodes without such pods, as strong as its weight (1 to 100) beside other preferences."""
    term = {"topologyKey": _HOSTNAME, "labelSelector": {"matchLabels": dict(labels)}}
    return {"weight": weight, "podAffinityTerm": term}


def leave_lost_nodes(spec: Object) -> None:
    """On a lost node a pod is replaced after LOST_SECONDS, not after Kubernetes' five minutes without an understudy."""
    given = spec.get("tolerations") or []
    spec["tolerations"] = [
        *given,
        *(
            {"key": key, "operator": "Exists", "effect": "NoExecute", "tolerationSeconds": LOST_SECONDS}
            for key in ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
            if not any(_tolerates(toleration, key) for toleration in given)
        ),
    ]


def _tolerates(toleration: Mapping[str, Any], key: str) -> bool:
    return toleration.get("key") in (key, None) and toleration.get("effect") in ("NoExecute", None)
