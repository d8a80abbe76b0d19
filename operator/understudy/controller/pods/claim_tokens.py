"""The Secret with which monitors and agents of shared pools authenticate each other: its owner, and how long it exists.

A claimed pod outlives its pool, because it then belongs to its workload and controls a robot. Its monitor still
commands it with that Secret, and its kubelet still mounts it. So the Secret has no owner.

- If the pool owned it, Kubernetes would delete it with the pool, whether an operator is running or not.
- If the workloads with a pod of the pool owned it, every claim would need a write, and the list of owners would be as
  long as the fleet. An operator would have to run between the claim and the pool's deletion.

The operator deletes the Secret when it is no longer needed. If no operator is running then, the Secret stays, but gives
no access to anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Create, Delete, Patch, Write
from understudy.controller.pods import instance_pod
from understudy.kube import claims
from understudy.kube.apply import controller_of
from understudy.kube.client import SECRETS, Object


def is_of(pool: str, secret: Object) -> bool:
    """Whether a Secret of that name is the pool's.

    A workload's name can be such that its own Secret has the same name.
    """
    owner = controller_of(secret)
    return kube_objects.labels(secret).get(names.POOL) == pool if owner is None else _is_pool(owner, pool)


def keep(pool: str, namespace: str, live: Object | None, token: Callable[[], str], *, keyed: bool) -> list[Write]:
    """Return the writes for a Secret without an owner. An existing one keeps its token. ``keyed`` is whether it has the monitors' keys."""
    if live is None or not is_of(pool, live):
        secret = ownership.agent_secret(names.pool_secret(pool), token, keyed=keyed)
        secret["metadata"]["labels"] = {names.POOL: pool}
        return [Create(SECRETS, ownership.nobodys(secret, namespace))]
    if released := release(pool, live):
        return released  # and next time, the keys
    patch = ownership.corrected_keys(live, token, keyed=keyed)
    return [Patch(SECRETS, live, patch)] if patch is not None else []


def release(pool: str, live: Object | None) -> list[Write]:
    """Return the writes that remove the owner of an existing Secret. In an earlier version, the pool owned it."""
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
    """Return the writes for the Secret of a deleted pool, or, with ``deleted``, of a pool that is being deleted.

    The Secret is needed as long as one of the pool's ``pods`` may be commanded. If it is missing then, another one is
    created, and the agents read it again.
    """
    needing = [pod for pod in pods if claimable(pod) or _is_commanded(pod, workloads)]
    if any(_is_claimed(pod) for pod in needing):
        return keep(pool, namespace, live, token, keyed=instance_pod.knows_keys(workloads.values()))
    if deleted or needing:
        return release(pool, live)
    return [Delete(SECRETS, live)] if live is not None and is_of(pool, live) else []


def pools_of(pods: Sequence[Object]) -> set[str]:
    """Return the shared pools from which pods were claimed."""
    return {claims.pool_of(pod) for pod in pods if _is_claimed(pod)}


def claimable(pod: Object) -> bool:
    """Whether a pod of a shared pool can still be claimed, or was claimed but the claim was not observed yet."""
    return claims.is_held(kube_objects.labels(pod)) and kube_objects.alive(pod)


def _is_claimed(pod: Object) -> bool:
    """Whether a pod was claimed and has not ended.

    A standby is never claimed: it was created for its workload, and has its token.
    """
    return names.CLAIM in kube_objects.notes(pod) and not kube_objects.ended(pod)


def _is_commanded(pod: Object, workloads: Mapping[str, Object]) -> bool:
    """Whether a pod was claimed and has a monitor. The pods of a deleted workload are deleted too."""
    return _is_claimed(pod) and (
        not kube_objects.deleted(pod) or claims.workload_of(kube_objects.labels(pod)) in workloads
    )


def _is_pool(owner: Object, pool: str) -> bool:
    found = (owner.get("apiVersion"), owner.get("kind"), owner.get("name"))
    return found == (API_VERSION, "FallbackPool", pool)
