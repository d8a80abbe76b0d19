"""The standbys of one workload: how many of each pool it should have, and the writes for that."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.controller.desired import effective_policy, standby_spread
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import (
    committed_recovery,
    degraded_measures,
    kube_objects,
    leaving_nodes,
    ownership,
    replacement_standbys,
    workload_reference,
)
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import Create, Delete, Patch, Plan
from understudy.controller.pods import instance_pod, pod_counts, pod_placement
from understudy.controller.pods.pool_pods import UniqueValues
from understudy.kube import apply, claims
from understudy.kube.client import PODS, REPLICA_SETS, Object


def wanted(observed: Observed, pool: str) -> int:
    """Return how many standbys of a pool the workload should have now."""
    return _kept(observed, pool) + degraded_measures.prewarmed(observed.workload, observed.policy, pool)


def _kept(observed: Observed, pool: str) -> int:
    """Return how many standbys of a pool the workload should always have.

    It is zero if other strategies were selected for the workload.
    """
    chosen = effective_policy.chosen(observed)
    if chosen is not None and pool not in effective_policy.counted_on(observed, chosen):
        return 0
    kept: int = observed.pools[pool]["spec"].get("perWorkload") or 0
    return kept


def own_pod_may_replace(observed: Observed) -> bool:
    """Whether a pod of the workload's own controller waits as a standby while another pod is active."""
    return replacement_standbys.may_replace(observed.workload, observed.policy)


def keep(made: Plan, observed: Observed, workload_plan: WorkloadPlan, pool: str, fresh: UniqueValues) -> None:
    """Keep as many standbys of a pool as the workload should have, with the current template."""
    workload, gate, built = observed.workload, observed.gate, workload_plan.builts[pool]
    owner = kube_objects.owner("RobotWorkload", workload)
    if observed.refused(pool) is not None:
        return
    unclaimed = [
        pod
        for pod in observed.pods
        if names.CLAIM not in kube_objects.notes(pod) and ownership.controls(kube_objects.uid(workload), pod)
    ]
    if any(_lost_its_pool(pod) and _pool_of(pod, observed, workload_plan) == pool for pod in unclaimed):
        return  # its label is being restored, and then it counts
    mine = [pod for pod in unclaimed if kube_objects.labels(pod).get(names.POOL) == pool]
    want, spared, renewal = wanted(observed, pool), 0, _Renewal()
    found = _spread(observed, workload_plan, pool, mine, want)
    if found.give_up is not None:
        mark = {"metadata": {"annotations": {names.NOT_MOVED: str(int(observed.now))}}}
        made.writes.append(Patch(PODS, found.give_up, mark))
    if not own_pod_may_replace(observed):
        # The pod with which a referred controller replaces the failed one has no agent, so it cannot be the standby.
        want += sum(kube_objects.is_active(pod, gate) for pod in mine) if want else 0
    elif want:
        renewal = _renewed(observed, workload_plan, pool, mine, want, found.move)
        want, spared = want + renewal.extra, _spared(observed, pool)
        made.writes += [Delete(PODS, pod) for pod in renewal.going]
        if renewal.taker is not None and renewal.moving is not None:
            mark = {"metadata": {"annotations": {names.REPLACES: kube_objects.uid(renewal.moving)}}}
            made.writes.append(Patch(PODS, renewal.taker, mark))
    stranded = [pod for pod in mine if standby_spread.stranded(pod, observed)]
    change = pod_counts.change(
        mine,
        want=want,
        template_hash=instance_pod.template_hash(built),
        expected=observed.expected.get(pool, 0),
        now=observed.now,
        kept=lambda pod: kube_objects.is_active(pod, gate),
        moving=lambda pod: pod is found.move or pod in stranded or leaving_nodes.on(pod, observed.leaving),
        hold=_held(observed),
        spared=spared,
    )
    replaced = found.move or renewal.moving or next(iter(stranded), None)
    notes = {names.REPLACES: kube_objects.uid(replaced)} if replaced is not None else {}
    for _ in range(change.create):
        name, namespace = fresh.name(kube_objects.name(workload)), workload["metadata"]["namespace"]
        body = instance_pod.pod(built, name=name, namespace=namespace, owner=owner, annotations=notes)
        if found.move is not None and observed.active is not None:
            body = pod_placement.apart_from(body, kube_objects.name(observed.active))
        made.writes.append(Create(PODS, body, counted=True))
    made.writes += [Delete(PODS, pod) for pod in change.delete]
    for delay in (change.again_after, found.again_after):
        if delay is not None:
            made.later(delay)


def _spread(
    observed: Observed, workload_plan: WorkloadPlan, pool: str, mine: Sequence[Object], want: int
) -> standby_spread.Spread:
    """Return what to do about the nodes of a pool's standbys; nothing while one may be about to take over."""
    if _held(observed):
        return standby_spread.Spread()
    standbys = [pod for pod in mine if kube_objects.alive(pod) and not kube_objects.is_active(pod, observed.gate)]
    if own_pod_may_replace(observed):
        standbys += replacement_standbys.of_pool(pool, observed.gate, observed.pods)
    return standby_spread.spread(observed, dict(workload_plan.template), workload_plan.builts[pool], standbys, want)


@dataclass(frozen=True)
class _Renewal:
    """How a pod of the workload's own controller is replaced that stands in for a standby."""

    extra: int = 0
    """Standbys beyond the wanted number."""
    going: Sequence[Object] = ()
    """The workload's own pods that can be deleted."""
    moving: Object | None = None
    """The own pod that a new standby is to replace on another node."""
    taker: Object | None = None
    """A standby that is to replace it instead of a new one: the pod that it replaced before is active now, so none waits for it."""


def _renewed(
    observed: Observed,
    workload_plan: WorkloadPlan,
    pool: str,
    mine: Sequence[Object],
    want: int,
    move: Object | None,
) -> _Renewal:
    """Return how the workload's own pods are replaced, beside a pool's standbys.

    A pod of the workload's own controller can stand in for a standby. If it has an old template, is on a node that is
    about to go, or is the one to ``move`` to another node, it waits like any standby. Like a standby, it is deleted when
    another one is ready. So there is one extra standby, which is kept until the controller's next pod is ready.
    If the pod stands in for no standby (for example, if a pod of a shared pool is active), the wanted standbys exist in
    addition to it. It is then deleted only because of its template, when a pool's standbys are ready.
    """
    gate, present = observed.gate, instance_pod.template_hash(workload_plan.builts[pool])
    if observed.active is None or kube_objects.labels(observed.active).get(names.SOURCE) == "workload":
        return _Renewal()
    displaced = replacement_standbys.displaced(gate, observed.pods)
    own = instance_pod.template_hash(workload_plan.builts[""])
    found = [pod for pod in observed.pods if replacement_standbys.is_own(pod)]
    outdated = [pod for pod in found if pod_counts.hash_of(pod) != own]
    moving = [
        pod
        for pod in found
        if pool == displaced and (pod is move or leaving_nodes.on(pod, observed.leaving)) and pod not in outdated
    ]
    if not outdated and not moving:
        return _Renewal()
    if displaced != pool and pool != _first_kept(observed, workload_plan, displaced):
        return _Renewal()
    ready = [
        pod
        for pod in mine
        if kube_objects.ready(pod)
        and pod_counts.hash_of(pod) == present
        and not kube_objects.is_active(pod, gate)
        and not leaving_nodes.on(pod, observed.leaving)
    ]
    live = observed.owned.get(("replicasets", kube_objects.name(observed.workload)))
    # Before the controller has the current template, it would create another pod of the old one.
    go = len(ready) >= want and live is not None and _template_of(live) == own and not _held(observed)
    # A template may place the controller's next pod on such a node again. No standby names that pod, so it stays:
    # otherwise, the replacement would never end.
    replaced = {kube_objects.notes(pod).get(names.REPLACES) for pod in ready}
    going = outdated + [pod for pod in moving if kube_objects.uid(pod) in replaced]
    takers = [pod for pod in ready if kube_objects.notes(pod).get(names.REPLACES) == kube_objects.uid(observed.active)]
    is_named = any(kube_objects.uid(pod) in replaced for pod in moving)
    taker = next(iter(takers), None) if moving and go and not is_named else None
    return _Renewal(int(pool == displaced), going if go else (), next(iter(moving), None), taker)


def _held(observed: Observed) -> bool:
    """Whether no standby may be deleted: a recovery or a planned switchover may be about to use any of them."""
    return observed.recovering or observed.handing_over


def _spared(observed: Observed, pool: str) -> int:
    """Return how many extra standbys are kept: one while the pod that is to stand in for a standby is not ready.

    The number of standbys does not show this: while one is being replaced on another node, both exist.
    """
    if replacement_standbys.displaced(observed.gate, observed.pods) != pool:
        return 0
    return int(not any(kube_objects.ready(pod) for pod in observed.pods if replacement_standbys.is_own(pod)))


def _first_kept(observed: Observed, workload_plan: WorkloadPlan, displaced: str) -> str:
    """Return the pool whose standbys decide when a pod that stands in for none is deleted.

    It is the first pool that keeps standbys. It is empty if there is none, or if the displaced pool keeps some.
    """
    kept = [
        name
        for name in sorted(workload_plan.builts)
        if name and observed.refused(name) is None and wanted(observed, name)
    ]
    return kept[0] if kept and displaced not in kept else ""


def _template_of(replica_set: Object) -> str:
    """Return the hash of the template from which a ReplicaSet creates pods."""
    found: str = (replica_set["spec"]["template"]["metadata"].get("labels") or {}).get(names.TEMPLATE_HASH, "")
    return found


def relabelled(observed: Observed, workload_plan: WorkloadPlan) -> Iterator[Patch]:
    """Yield patches that restore the labels and the owner of the workload's pods that somebody changed or removed.

    The policies of the gate select by these labels. A pod without them would be fenced by no policy. A pod without an
    owner would outlive the workload and its policies.
    """
    workload = observed.workload
    for pod in observed.pods:
        released = apply.released(pod) == kube_objects.name(workload)
        if kube_objects.deleted(pod) or not (released or ownership.controls(kube_objects.uid(workload), pod)):
            continue
        wanted = {
            names.COMPONENT: "instance",
            **claims.instance_labels(pod, kube_objects.name(workload)),
        }
        if released and observed.reference is None and names.POOL not in kube_objects.labels(pod):
            # The ReplicaSet then adopts the pod again, and deletes the newer pod if it has two.
            wanted[names.SOURCE] = "workload"
        elif (
            names.POOL not in kube_objects.labels(pod) and (pool := _pool_of(pod, observed, workload_plan)) is not None
        ):
            wanted[names.POOL] = pool
        yield from workload_reference.label(pod, wanted)
        if released and names.POOL in kube_objects.labels(pod):
            owner = kube_objects.owner("RobotWorkload", workload)
            yield Patch(PODS, pod, {"metadata": {"ownerReferences": [owner]}})


def _lost_its_pool(pod: Object) -> bool:
    """Whether somebody has removed the label with the pool of a living standby."""
    return names.POOL not in kube_objects.labels(pod) and not kube_objects.deleted(pod)


def _pool_of(pod: Object, observed: Observed, workload_plan: WorkloadPlan) -> str | None:
    """Return the pool of a pod without the pool's label, if its claim, its template or the number of pools shows it."""
    if names.CLAIM in kube_objects.notes(pod):
        return claims.pool_of(pod) or None
    of_template = [
        pool
        for pool, built in workload_plan.builts.items()
        if pool and instance_pod.template_hash(built) == pod_counts.hash_of(pod)
    ]
    pools = of_template or list(observed.standby_pools)
    return pools[0] if len(pools) == 1 else None


def scale(made: Plan, observed: Observed) -> None:
    """Scale the workload's ReplicaSet to one pod, or to none while a shared pool's pod is active and no standby is needed.

    The scale does not change while the gate is closed, because the monitor may be changing it. It also does not change
    while a switchover is requested or in progress: a pod may be started for it, beside the active one.
    """
    live = observed.owned.get(("replicasets", kube_objects.name(observed.workload)))
    if live is None or observed.gate is None or not kube_objects.active(observed.gate)[0]:
        return
    if observed.handing_over or observed.switchover.get("phase") == "Waiting":
        return
    driving = [p for p in observed.pods if kube_objects.is_active(p, observed.gate) and kube_objects.alive(p)]
    foreign = any(kube_objects.labels(pod).get(names.SOURCE) != "workload" for pod in driving)
    standing_by = sum(wanted(observed, pool) for pool in observed.standby_pools) if own_pod_may_replace(observed) else 0
    replicas = 0 if foreign and not standing_by else 1
    if (live.get("spec") or {}).get("replicas", 1) != replicas:
        made.writes.append(Patch(REPLICA_SETS, live, {"spec": {"replicas": replicas}}, subresource="scale"))


def awaited(observed: Observed, workload_plan: WorkloadPlan) -> str | None:
    """Return why the ReplicaSet does not receive the current template yet, or None.

    A restart must not fail because of a template that cannot start. So if there are standbys, one of the new template
    must be ready first. While a standby is active, this does not apply.
    """
    built, live = (
        workload_plan.builts.get(""),
        observed.owned.get(("replicasets", kube_objects.name(observed.workload))),
    )
    if built is None or live is None:
        return None
    if _template_of(live) == instance_pod.template_hash(built):
        return None
    if any(
        kube_objects.is_active(pod, observed.gate) and names.POOL in kube_objects.labels(pod) for pod in observed.pods
    ):
        return None
    pools_first = {
        name: instance_pod.template_hash(workload_plan.builts[name])
        for name in observed.standby_pools
        if _kept(observed, name)
    }
    if not pools_first or any(
        kube_objects.ready(pod)
        and pools_first.get(kube_objects.labels(pod).get(names.POOL, "")) == pod_counts.hash_of(pod)
        for pod in observed.pods
    ):
        return None
    message = f"ReplicaSet {kube_objects.name(observed.workload)} gets the new template after a standby of that template is ready"
    unmade = [name for name in sorted(pools_first) if observed.refused(name) is not None]
    return f"{message}, and FallbackPool {unmade[0]}, which is not accepted, makes none" if unmade else message


def sweep(made: Plan, observed: Observed) -> None:
    """Delete standbys of pools that no longer serve the workload."""
    if _held(observed):
        made.later(committed_recovery.LASTS)  # the recovery may have been abandoned, which nothing reports
        return
    serving_now = observed.standby_pools
    for pod in observed.pods:
        pool = kube_objects.labels(pod).get(names.POOL)
        if (
            pool
            and pool not in serving_now
            and names.CLAIM not in kube_objects.notes(pod)
            and ownership.controls(kube_objects.uid(observed.workload), pod)
            and not kube_objects.is_active(pod, observed.gate)
            and not kube_objects.deleted(pod)
        ):
            made.writes.append(Delete(PODS, pod))
