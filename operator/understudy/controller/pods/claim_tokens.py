"""The Secret by which monitors and the agents of a shared pool's pods know each other: who has it, and for how long.

A claimed pod outlives its pool, since it is its workload's by then and drives a robot. Its monitor goes on commanding it by that Secret,
and its kubelet goes on mounting it. So the Secret belongs to nobody: a pool's would be deleted with the pool by Kubernetes, whether an
operator is there or not. As the workloads' that have a pod of it, it would take a write after every claim, a list as long as the fleet, and
an operator that is there between the claim and the pool's deletion. The operator takes it away when nobody needs it any more. Where there
is no operator by then it is left over, and opens nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Create, Delete, Patch, Write
from understudy.kube.apply import controller_of
from understudy.kube.client import SECRETS, Object


def is_of(pool: str, secret: Object) -> bool:
    """Whether a Secret of that name is the pool's: a workload may have a name by which its own is called so too."""
    owner = controller_of(secret)
    return kube_objects.labels(secret).get(names.POOL) == pool if owner is None else _is_pool(owner, pool)


def keep(pool: str, namespace: str, live: Object | None, token: Callable[[], str]) -> list[Write]:
    """The writes by which the Secret is there and is nobody's. One that is there keeps its token."""
    if live is None or not is_of(pool, live):
        return [Create(SECRETS, ownership.nobodys(_secret(pool, token()), namespace))]
    return release(pool, live)


def release(pool: str, live: Object | None) -> list[Write]:
    """The writes by which a Secret that is there is nobody's. The pool of an earlier version owned it."""
    if live is None or not is_of(pool, live) or controller_of(live) is None:
        return []
    others = [owner for owner in live["metadata"]["ownerReferences"] if not _is_pool(owner, pool)]
    return [Patch(SECRETS, live, {"metadata": {"labels": {names.POOL: pool}, "ownerReferences": others or None}})]


def outlast(
    pool: str,
    namespace: str,
    live: Object | None,
    *,
    deleted: bool,
    pods: Sequence[Object],
    workloads: Mapping[str, Object],
    token: Callable[[], str],
) -> list[Write]:
    """The writes for the Secret of a pool that is gone, or with ``deleted`` of one that still waits for what holds it.

    It is needed as long as one of the pool's ``pods`` may be commanded. If it isn't there then, another one is made: agents read it anew.
    """
    needing = [pod for pod in pods if claimable(pod) or _is_commanded(pod, workloads)]
    if any(_is_claimed(pod) for pod in needing):
        return keep(pool, namespace, live, token)
    if deleted or needing:
        return release(pool, live)
    return [Delete(SECRETS, live)] if live is not None and is_of(pool, live) else []


def pools_of(pods: Sequence[Object]) -> set[str]:
    """The shared pools from which pods were claimed."""
    return {kube_objects.labels(pod).get(names.POOL, "") for pod in pods if _is_claimed(pod)}


def claimable(pod: Object) -> bool:
    """Whether a pod of a shared pool may be claimed yet, or has been, and that just wasn't seen."""
    return names.HELD in kube_objects.labels(pod) and kube_objects.alive(pod)


def _is_claimed(pod: Object) -> bool:
    """Whether a pod was claimed and hasn't ended. A standby never is: it was made for its workload, and has that one's token."""
    return names.CLAIM in kube_objects.notes(pod) and not kube_objects.ended(pod)


def _is_commanded(pod: Object, workloads: Mapping[str, Object]) -> bool:
    """Whether a pod was claimed and there is a monitor for it. The pods of a workload that is gone go too."""
    return _is_claimed(pod) and (
        not kube_objects.deleted(pod) or kube_objects.labels(pod).get(names.WORKLOAD) in workloads
    )


def _is_pool(owner: Object, pool: str) -> bool:
    found = (owner.get("apiVersion"), owner.get("kind"), owner.get("name"))
    return found == (API_VERSION, "FallbackPool", pool)


def _secret(pool: str, token: str) -> Object:
    made = ownership.token(names.pool_secret(pool), token)
    return {**made, "metadata": {**made["metadata"], "labels": {names.POOL: pool}}}
