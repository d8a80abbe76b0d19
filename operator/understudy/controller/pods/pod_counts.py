"""How many pods of one kind to make and which to delete: for a workload's standbys and for a pool's held pods alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

REST_SECONDS = 10.0
"""A pod that ended (such as one that its node refused) is replaced after so long: no busy loop of refusals."""

EXPECTED_SECONDS = 60.0
"""Seconds after which a pod that nobody has observed counts as never made; a request's own timeout is far shorter."""


@dataclass(frozen=True)
class Change:
    """What to do."""

    create: int = 0
    delete: list[Object] = field(default_factory=list)
    again_after: float | None = None


@dataclass(frozen=True)
class Update:
    """What becomes of pods of an old template."""

    stay: bool = False
    """They are as good as new ones, and stay until they are taken."""
    min_ready: int | None = None
    """How many that are ready are left to be claimed meanwhile; None where none goes before one is ready in its place."""


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
    """The change that leads to ``want`` pods of the present template.

    ``expected`` pods were created and haven't been observed yet: they count, so a stale read never makes too many. Nothing
    tells of one that was never made, so it is looked again once it isn't expected any more.
    ``kept`` pods (the active one) count at any template and are never deleted. Pods of an old template go only as
    far as ready ones of the present one have come, which is make before break, unless ``update`` says otherwise. So do
    those that are ``moving``, since their node is about to go: they are replaced elsewhere first. With
    ``hold`` (a recovery or a switchover is under way, which may be about to use any of them) none is deleted that may still run.
    ``spared`` more than are wanted stay where there are so many, the best of them; none is made for that.
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
    # Where a template has its pods placed on such a node again, twice as many as are wanted are enough.
    surplus = max(0, len(leaving) - want)
    create = max(0, want - surplus - len(present) - len(resting) - expected)
    if hold:
        # Only the last one that ended may mean something to it. The others' places are filled, so that they'd be more and more.
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
    """The pods that are to be replaced and aren't needed until the ones in their place are ready."""
    ready = sum(kube_objects.ready(pod) for pod in present)
    missing = max(0, want - ready)
    # Those whose node is about to go stay until all is well without them: where others are placed there again, as a template may
    # have it, it would never end if they went one by one.
    found = [] if missing else list(leaving)
    if update.min_ready is None:
        return found + sorted(outdated, key=lambda pod: not kube_objects.ready(pod))[missing:]
    least = min(want, update.min_ready)
    allowed = claimable([*leaving, *outdated, *present], template_hash, update)
    staying = max(0, least - ready) if allowed == template_hash else least
    return found + sorted(outdated, key=lambda pod: (hash_of(pod) != allowed, not kube_objects.ready(pod)))[staying:]


def hash_of(pod: Object) -> str:
    """The hash of the template that a pod was made from."""
    return kube_objects.labels(pod).get(names.TEMPLATE_HASH, "")


def claimable(unclaimed: Sequence[Object], present: str, update: Update = Update()) -> str:
    """The template whose held pods may be claimed: the present one as soon as one of it is ready, or as many as are to be.

    Until then the one with most ready pods, so that a new template that can't start takes nothing away. Empty for any, where those
    of an old one are as good.
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
