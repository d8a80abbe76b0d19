"""Moves a standby away from the node of the active instance, whose loss would end both.

The scheduler places pods by preference, and never moves them. After a failover, the remaining standby may be on the node of the new active
instance, for example because the other node was lost for a while. A pod that must not be on that node is created first, so that
the number of ready standbys never becomes smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.api.whole_numbers import whole_number
from understudy.controller.observed import kube_objects, leaving_nodes, pod_diagnosis
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import pod_counts, pod_placement
from understudy.kube.client import Object

REST_SECONDS = 1800.0
"""Seconds until the next attempt after a replacement could not start. Only a longer look at the nodes shows whether they have room."""

_UNPLACED_SECONDS, _STARTING_SECONDS = 30.0, 120.0
"""Seconds after which a replacement that reports a problem, and one that is only not ready, is given up."""


@dataclass(frozen=True)
class Spread:
    """What to do about the node of a pool's standbys."""

    move: Object | None = None
    """The standby to replace on another node."""
    give_up: Object | None = None
    """The standby whose replacement could not start."""
    again_after: float | None = None
    """Seconds until this may have changed although nothing reports it."""


def spread(observed: Observed, template: Object, built: Object, standbys: Sequence[Object], want: int) -> Spread:
    """Return which of a pool's standbys to replace on another node: one, if none that counts is on another node.

    ``template`` is the user's, ``built`` that of the standbys. ``standbys`` includes a pod of the workload's own
    controller that waits in place of one.
    """
    active = observed.active
    if active is None or not want or len(standbys) < want or pod_placement.places_itself(template):
        return Spread()
    place = leaving_nodes.of(active)
    beside = sorted((pod for pod in standbys if leaving_nodes.of(pod) == place), key=_first_to_go)
    # While a standby is replaced, there is one too many, and the one elsewhere is not another one.
    if not place or not beside or len(standbys) - len(beside) > len(standbys) - want:
        return Spread()
    if any(leaving_nodes.on(pod, observed.leaving) for pod in (active, *standbys)) or any(
        _of_pool(pod) and pod_counts.hash_of(pod) != built["metadata"]["labels"][names.TEMPLATE_HASH]
        for pod in standbys
    ):
        return Spread()  # these are replaced elsewhere for another reason
    rest = observed.left(REST_SECONDS, since=max(map(_tried, beside)))
    if rest > 0.0:
        return Spread(again_after=rest)
    if not leaving_nodes.another_accepts(observed.nodes, place, built["spec"].get("tolerations") or []):
        return Spread()
    for pod in standbys:
        if names.REPLACES in kube_objects.notes(pod) and not kube_objects.ready(pod):
            limit = _UNPLACED_SECONDS if pod_diagnosis.trouble(pod) is not None else _STARTING_SECONDS
            rest = observed.left(limit, since=kube_objects.created(pod))
            return Spread(move=beside[0], again_after=rest) if rest > 0.0 else Spread(give_up=beside[0])
    return Spread(move=beside[0])


def stranded(pod: Object, observed: Observed) -> bool:
    """Whether a replacement has no node, and the pod that it was to replace is gone. It is no standby, and may never become one."""
    replaced = kube_objects.notes(pod).get(names.REPLACES)
    is_waiting = replaced is not None and not leaving_nodes.of(pod)
    return is_waiting and all(kube_objects.uid(other) != replaced for other in observed.pods)


def _first_to_go(pod: Object) -> tuple[bool, bool, float, str]:
    return not _of_pool(pod), kube_objects.ready(pod), *kube_objects.sort_key(pod)


def _of_pool(pod: Object) -> bool:
    return names.POOL in kube_objects.labels(pod)


def _tried(pod: Object) -> float:
    time = whole_number(kube_objects.notes(pod).get(names.NOT_MOVED, ""))
    return float(time) if time is not None else float("-inf")
