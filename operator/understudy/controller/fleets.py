"""How many pods of one kind to make and which to delete: for a workload's standbys and for a pool's held pods alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from understudy.api import names
from understudy.cluster.client import Object
from understudy.controller import objects
from understudy.controller.expectations import LASTS

REST_SECONDS = 10.0
"""A pod that ended (such as one that its node refused) is replaced after so long: no busy loop of refusals."""


@dataclass(frozen=True)
class Change:
    """What to do."""

    create: int = 0
    delete: list[Object] = field(default_factory=list)
    again_after: float | None = None


def change(
    pods: Sequence[Object],
    *,
    want: int,
    template_hash: str,
    expected: int,
    now: float,
    kept: Callable[[Object], bool] = lambda pod: False,
    hold: bool = False,
) -> Change:
    """The change that leads to ``want`` pods of the present template.

    ``expected`` pods were created and haven't been observed yet: they count, so a stale read never makes too many. Nothing
    tells of one that was never made, so it is looked again once it isn't expected any more.
    ``kept`` pods (the active one) count at any template and are never deleted. Pods of an old template go only as
    far as ready ones of the present one have come: make before break. With ``hold`` (a recovery is under way, which
    may be about to use any of them) nothing is deleted.
    """
    ended = [pod for pod in pods if objects.ended(pod) and not kept(pod)]
    resting = [pod for pod in ended if now - objects.created(pod) < REST_SECONDS]
    over = [pod for pod in ended if now - objects.created(pod) >= REST_SECONDS]
    live = sorted((pod for pod in pods if objects.alive(pod)), key=objects.sort_key)
    present = [pod for pod in live if kept(pod) or hash_of(pod) == template_hash]
    old = [pod for pod in live if not kept(pod) and hash_of(pod) != template_hash]
    rest = max((REST_SECONDS - (now - objects.created(pod)) for pod in resting), default=None)
    again = min((delay for delay in (rest, LASTS if expected else None) if delay is not None), default=None)
    create = max(0, want - len(present) - len(resting) - expected)
    if hold:
        return Change(create=create, again_after=again)
    delete = over
    free = sorted(
        (pod for pod in present if not kept(pod)), key=lambda pod: (objects.ready(pod), -objects.created(pod))
    )
    delete += free[: max(0, len(present) - want)]
    staying = max(0, want - sum(objects.ready(pod) for pod in present))
    delete += sorted(old, key=lambda pod: not objects.ready(pod))[staying:]
    return Change(create=create, delete=delete, again_after=again)


def hash_of(pod: Object) -> str:
    """The hash of the template that a pod was made from."""
    return objects.labels(pod).get(names.TEMPLATE_HASH, "")


def claimable(unclaimed: Sequence[Object], present: str) -> str:
    """The template whose held pods may be claimed: the present one as soon as one of it is ready.

    Until then the one with most ready pods, so that a new template that can't start takes nothing away.
    """
    ready: dict[str, int] = {}
    for pod in unclaimed:
        if objects.ready(pod):
            ready[hash_of(pod)] = ready.get(hash_of(pod), 0) + 1
    if not ready or present in ready:
        return present
    return max(sorted(ready), key=lambda found: ready[found])
