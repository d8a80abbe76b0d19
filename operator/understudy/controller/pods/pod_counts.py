"""Determines how many pods to create and which to delete, for a workload's standbys and for a pool's held pods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

REST_SECONDS = 10.0
"""Seconds until a pod that ended is replaced. This avoids a busy loop if, for example, a node rejects each pod."""

EXPECTED_SECONDS = 60.0
"""Seconds after which an unobserved pod counts as not created. The timeout of a request is far shorter."""


@dataclass(frozen=True)
class Change:
    """The changes to make."""

    create: int = 0
    delete: list[Object] = field(default_factory=list)
    again_after: float | None = None


@dataclass(frozen=True)
class Update:
    """How pods of an old template are replaced."""

    stay: bool = False
    """Whether old pods count like new ones, and stay until they are claimed."""
    min_ready: int | None = None
    """How many ready pods stay claimable during the update; None if no pod is deleted before its replacement is ready."""


def change(
    pods: Sequence[Object],
    *,
    want: int,
    template_hash: str,
    expected: int,
    now: float,
    kept: Callable[[Object], bool] = lambda pod: False,
    moving: Callable[[Object], bool] = lambda pod: False,
    hold: bool = False,
    spared: int = 0,
    update: Update = Update(),
) -> Change:
    """Return the change that leads to ``want`` pods of the current template.

    ``expected`` pods were created but not yet observed. They count, so a stale read never creates extra pods. Nothing
    reports a pod whose creation failed, so the count is repeated when the pod is no longer expected.
    ``kept`` pods (the active one) count with any template and are never deleted.
    Pods of an old template are deleted only after ready pods of the current one exist (make before break), unless
    ``update`` says otherwise. The same holds for ``moving`` pods, whose node is about to go: they are first replaced on
    other nodes.
    With ``hold``, no pod that may still run is deleted, because a recovery or a switchover may be about to use any of
    them.
    Of the pods beyond ``want``, the best ``spared`` ones stay if they exist; none is created for that.
    """
    ended = [pod for pod in pods if kube_objects.ended(pod) and not kept(pod)]
    resting = [pod for pod in ended if now - kube_objects.created(pod) < REST_SECONDS]
    over = [pod for pod in ended if now - kube_objects.created(pod) >= REST_SECONDS]
    live = sorted((pod for pod in pods if kube_objects.alive(pod)), key=kube_objects.sort_key)
    fitting = [pod for pod in live if kept(pod) or update.stay or hash_of(pod) == template_hash]
    outdated = [pod for pod in live if not (kept(pod) or update.stay or hash_of(pod) == template_hash)]
    present = [pod for pod in fitting if kept(pod) or not moving(pod)]
    leaving = [pod for pod in fitting if not kept(pod) and moving(pod)]
    rest = max((REST_SECONDS - (now - kube_objects.created(pod)) for pod in resting), default=None)
    again = min((delay for delay in (rest, EXPECTED_SECONDS if expected else None) if delay is not None), default=None)
    # If a template always places its pods on such a node, twice the wanted number is enough.
    surplus = max(0, len(leaving) - want)
    create = max(0, want - surplus - len(present) - len(resting) - expected)
    if hold:
        # Only the last ended pod may matter to a recovery. The others are replaced, so they would accumulate.
        return Change(create=create, delete=sorted(over, key=kube_objects.sort_key)[:-1], again_after=again)
    free = sorted(
        (pod for pod in present if not kept(pod)),
        key=lambda pod: (kube_objects.ready(pod), hash_of(pod) == template_hash, -kube_objects.created(pod)),
    )
    going = free[: max(0, len(present) - want)] + _replaced(leaving, outdated, present, want, template_hash, update)
    if spared:
        going.sort(key=lambda pod: (kube_objects.ready(pod), hash_of(pod) == template_hash, not moving(pod)))
        going = going[: max(0, len(live) - want - spared)]
    return Change(create=create, delete=over + going, again_after=again)


def _replaced(
    leaving: Sequence[Object],
    outdated: Sequence[Object],
    present: Sequence[Object],
    want: int,
    template_hash: str,
    update: Update,
) -> list[Object]:
    """Return the pods to replace that are not needed until their replacements are ready."""
    ready = sum(kube_objects.ready(pod) for pod in present)
    missing = max(0, want - ready)
    # Pods whose node is about to go stay until all wanted pods are ready without them. If the template places the
    # replacements on such a node again, replacing them one by one would never end.
    found = [] if missing else list(leaving)
    if update.min_ready is None:
        return found + sorted(outdated, key=lambda pod: not kube_objects.ready(pod))[missing:]
    least = min(want, update.min_ready)
    allowed = claimable([*leaving, *outdated, *present], template_hash, update)
    staying = max(0, least - ready) if allowed == template_hash else least
    return found + sorted(outdated, key=lambda pod: (hash_of(pod) != allowed, not kube_objects.ready(pod)))[staying:]


def hash_of(pod: Object) -> str:
    """Return the hash of the template from which a pod was created."""
    return kube_objects.labels(pod).get(names.TEMPLATE_HASH, "")


def claimable(unclaimed: Sequence[Object], present: str, update: Update = Update()) -> str:
    """Return the hash of the template whose held pods may be claimed; empty if any may, because old ones are as good.

    It is the current template as soon as one pod of it is ready, or ``min_ready`` of them. Until then it is the one
    with the most ready pods, so that a new template that cannot start takes nothing away.
    """
    if update.stay:
        return ""
    ready: dict[str, int] = {}
    for pod in unclaimed:
        if kube_objects.ready(pod):
            ready[hash_of(pod)] = ready.get(hash_of(pod), 0) + 1
    if not ready or ready.get(present, 0) >= max(1, update.min_ready or 0):
        return present
    return max(sorted(ready), key=lambda found: (ready[found], found == present))
