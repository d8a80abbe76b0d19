"""FallbackPools: the observed state around a pool, the evaluation of its spec, and the held pods of a shared one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from understudy.api import names
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.whole_numbers import whole_number
from understudy.controller.observed import kube_objects, leaving_nodes, ownership, pool_reader
from understudy.controller.plan import Apply, Create, Delete, Images, Plan, Problem
from understudy.controller.pods import claim_tokens, instance_pod, pod_counts, pool_evictions, pool_size
from understudy.controller.pods.pool_size import Sized
from understudy.failover.pool_queue import Waiter, in_order
from understudy.failover.progress import waiter
from understudy.kube import claims, selectors
from understudy.kube.client import DISRUPTION_BUDGETS, PODS, Object
from understudy.kube.gates import pool_pod_policies

MOVING = "Moving"
"""The condition that exists while pods are being replaced on other nodes."""

FIRST_THE_CLAIMED = 10.0
"""Seconds for a claimed pod to become active before its replacement starts, perhaps on the same node.

A robot waits for the claimed pod, and nothing waits for the replacement.
"""


@dataclass(frozen=True)
class Observed:
    """The observed state around a pool."""

    pool: Object
    workloads: Mapping[str, Object]
    """All RobotWorkloads of the namespace."""
    pods: Sequence[Object]
    """Pods with the pool's label, regardless of their current owner."""
    owned: Mapping[tuple[str, str], Object]
    """Objects that the pool controls, except pods, by plural and name."""
    now: float
    source: Mapping[str, Any] | None = None
    """Pod template of the workload in ``templateFrom``, if it has one."""
    source_selector: Mapping[str, Any] | None = None
    """Selector of that workload's referred controller, if it has one."""
    active: frozenset[str] = frozenset()
    """UIDs of all active pods, of any workload."""
    replacement_standbys: Sequence[Object] = ()
    """Pods of its workloads' own controllers that stand by while a pod of this pool is active."""
    expected: int = 0
    """Number of pods that were created but not yet observed."""
    prewarmed: int = 0
    """Number of workloads that should have an additional standby because they are degraded."""
    waiting: Sequence[Waiter] = ()
    """The workloads that wait for a pod of this pool, in the order in which they are served."""
    spared: int = 0
    """Number of workloads that it serves and that need no standby of it, because other strategies were selected."""
    asking: Sequence[Object] = ()
    """The workloads that claim a pod of it when they fail, if its size follows the failure rate."""
    leaving: frozenset[str] = frozenset()
    """The nodes whose pods are about to go."""
    cordoned: frozenset[str] = frozenset()
    """The nodes that are being drained or are cordoned, also if there is no other node."""
    budgets: Sequence[Object] = ()
    """PodDisruptionBudgets of the namespace that Understudy did not create."""
    secret: Object | None = None
    """The Secret with the name of the pool's agent Secret, or None."""


@dataclass(frozen=True)
class PoolPlan:
    """The result of evaluating a pool's spec."""

    spec: FallbackPoolSpec | None = None
    problem: Problem | None = None
    built: Object | None = None
    """The pod template of its held pods, for a shared pool."""
    sized: Sized | None = None
    """Its size, if it follows the failure rate."""


def unclaimed(pool: Object, pods: Sequence[Object]) -> list[Object]:
    """Return the pods that a shared pool holds: it still controls them, and they are still held."""
    return [
        pod
        for pod in pods
        if claims.is_held(kube_objects.labels(pod)) and ownership.controls(kube_objects.uid(pool), pod)
    ]


def queue(pool: str, gates: Sequence[Object], now: float) -> list[Waiter]:
    """Return the workloads that wait for a pod of a shared pool, by their gates, in the order in which they are served."""
    found = []
    for gate in gates:
        if kube_objects.labels(gate).get(names.WAITS_FOR) != pool:
            continue
        one = waiter(kube_objects.notes(gate).get(names.RECOVERY, ""))
        if one is not None and names.gate(one.workload) == kube_objects.name(gate):  # counts only for its own workload
            found.append(one)
    return in_order(found, pool, now)


def evaluate(observed: Observed, images: Images) -> PoolPlan:
    """Evaluate a pool's spec, before the API server validates its template."""
    pool = observed.pool
    refused = pool_reader.problem(pool)
    if refused is not None and refused.reason == "SpecInvalid":
        return PoolPlan(problem=refused)
    spec = pool_reader.spec(pool)
    sized = pool_size.sized(pool, spec, observed.asking, observed.now)
    if refused is not None:
        return PoolPlan(spec, refused, sized=sized)
    if not spec.level.shared:
        return PoolPlan(spec)
    template, path, image = spec.template, "spec.template", images
    if spec.template_from is not None:
        source = spec.template_from.workload
        path = f"RobotWorkload {source}: spec.template"
        template = dict(observed.source) if observed.source is not None else None
        if template is None:
            return PoolPlan(spec, _no_source(source, observed), sized=sized)
        own = ((observed.workloads[source].get("spec") or {}).get("monitor") or {}).get("image")
        image = replace(images, monitor=own or images.monitor)
    if found := instance_pod.problem(template or {}, held=True, path=path):
        return PoolPlan(spec, Problem("TemplateInvalid", found), sized=sized)
    if spec.preload and not instance_pod.preloads(template or {}):
        return PoolPlan(spec, Problem("TemplateInvalid", _nothing_preloads(path)), sized=sized)
    requirements = selectors.requirements(observed.source_selector or {})
    recipe = instance_pod.Recipe(
        workload="",
        namespace=pool["metadata"]["namespace"],
        images=image,
        agent_protocol=instance_pod.agent_protocol(image.monitor, observed.workloads.values()),
        secret=names.pool_secret(kube_objects.name(pool)),
        pool=kube_objects.name(pool),
        held=True,
        warm_paths=spec.warm_paths,
        preload=spec.preload or (),
        stripped=frozenset(requirement["key"] for requirement in requirements),
    )
    return PoolPlan(spec, built=instance_pod.build(template or {}, recipe), sized=sized)


def _nothing_preloads(path: str) -> str:
    return (
        f"spec.preload: no container of {path} has a command that begins with python3, in whose interpreter the modules could wait. "
        "Let the command begin with it (such as [python3, -m, my_package]), or remove spec.preload"
    )


def _no_source(source: str, observed: Observed) -> Problem:
    if source in observed.workloads:
        message = f'spec.templateFrom.workload: the controller that RobotWorkload "{source}" refers to does not exist'
    else:
        message = (
            f'spec.templateFrom.workload: no RobotWorkload "{source}" in namespace '
            f"{observed.pool['metadata']['namespace']} ({kube_objects.hint(source, observed.workloads)})"
        )
    return Problem("TemplateSourceNotFound", f"{message}. Existing pods of the pool are kept")


@dataclass(frozen=True)
class UniqueValues:
    """The source of unique names and secrets."""

    name: Callable[[str], str]
    token: Callable[[], str] = field(repr=False)


def plan(observed: Observed, pool_plan: PoolPlan, fresh: UniqueValues) -> Plan:
    """Return the writes for a pool. Claimed pods are never among them.

    If the spec is not accepted, no pods are created or deleted.
    """
    made = Plan()
    spec, built = pool_plan.spec, pool_plan.built
    if pool_plan.problem is not None or spec is None or built is None or kube_objects.deleted(observed.pool):
        made.writes += claim_tokens.release(kube_objects.name(observed.pool), observed.secret)
        if any(leaving_nodes.on(pod, observed.leaving | observed.cordoned) for pod in observed.pods):
            _permit_evictions(made, observed)  # there will be no replacements
        return made
    pool, name = observed.pool, kube_objects.name(observed.pool)
    owner = kube_objects.owner("FallbackPool", pool)
    held = unclaimed(pool, observed.pods)
    present = instance_pod.template_hash(built)
    keyed = instance_pod.knows_keys(observed.workloads.values())
    made.writes += claim_tokens.keep(name, pool["metadata"]["namespace"], observed.secret, fresh.token, keyed=keyed)
    living = [pod for pod in held if kube_objects.alive(pod)]
    want = pool_size.wanted(spec, pool_plan.sized)
    update = _update(spec, want)
    # The network policy that names the claimable pods is written before other pods are deleted.
    policy = pool_pod_policies.held_pods(name, pod_counts.claimable(living, present, update))
    made.writes.append(Apply(pool_pod_policies.RESOURCE, ownership.ours(policy, owner, pool)))
    change = pod_counts.change(
        held,
        want=want,
        template_hash=present,
        expected=observed.expected,
        now=observed.now,
        moving=lambda pod: leaving_nodes.on(pod, observed.leaving),
        update=update,
    )
    _hold(made, observed, living, built, want)
    namespace = pool["metadata"]["namespace"]
    waits = _until_driving(observed)
    # Each claim delays only its own replacement. So the pool still fills up under a steady series of claims.
    due = max(0, change.create - len(waits))
    if change.create > due:
        made.later(min(waits))
    for _ in range(due):
        body = instance_pod.pod(built, name=fresh.name(name), namespace=namespace, owner=owner)
        made.writes.append(Create(PODS, body, counted=True))
    made.writes += [Delete(PODS, pod) for pod in change.delete]
    if change.again_after is not None:
        made.later(change.again_after)
    for one in observed.waiting:  # a monitor that is gone leaves its wait entry behind
        made.later(one.until - observed.now)
    if pool_plan.sized is not None:
        made.later(pool_size.RECALCULATE_AFTER)
    return made


def _hold(made: Plan, observed: Observed, living: Sequence[Object], built: Object, want: int) -> None:
    """Delay evictions of waiting pods until others exist on other nodes, as long as those may still start."""
    name = kube_objects.name(observed.pool)
    moving = any(leaving_nodes.on(pod, observed.leaving) for pod in living)
    coming = [pod for pod in living if not kube_objects.ready(pod) and not leaving_nodes.on(pod, observed.leaving)]
    left = pool_evictions.patience(coming, _moving_since(observed), observed.now) if moving else pool_evictions.PATIENCE
    if (
        not want
        or not left
        or stranded(observed, living)
        or pool_evictions.decided_elsewhere(observed.budgets, built["metadata"]["labels"])
    ):
        _permit_evictions(made, observed)
        return
    owner = kube_objects.owner("FallbackPool", observed.pool)
    made.writes.append(
        Apply(DISRUPTION_BUDGETS, ownership.ours(pool_evictions.budget(name, want), owner, observed.pool))
    )
    if moving:
        made.later(left)


def stranded(observed: Observed, pods: Sequence[Object]) -> bool:
    """Whether pods are on a node that is drained while no other node remains, so that no replacements are created."""
    return not observed.leaving and any(leaving_nodes.on(pod, observed.cordoned) for pod in pods)


def _moving_since(observed: Observed) -> float:
    """Return since when pods are being replaced on other nodes, from the pool's status; now if it is not there yet."""
    conditions = (observed.pool.get("status") or {}).get("conditions") or []
    since = next((one["lastTransitionTime"] for one in conditions if one["type"] == MOVING), None)
    return datetime.fromisoformat(since).timestamp() if since is not None else observed.now


def _permit_evictions(made: Plan, observed: Observed) -> None:
    """Permit evictions of waiting pods."""
    live = observed.owned.get((DISRUPTION_BUDGETS.plural, names.held(kube_objects.name(observed.pool))))
    if live is not None and not kube_objects.deleted(live):
        made.writes.append(Delete(DISRUPTION_BUDGETS, live))


def _update(spec: FallbackPoolSpec, want: int) -> pod_counts.Update:
    """Return how pods of an old template are replaced, for a pool of this size."""
    found = spec.update_strategy
    if found is None:
        return pod_counts.Update()
    least = min(want, found.min_ready) if found.min_ready is not None else None
    return pod_counts.Update(stay=found.type == "OnReplenish", min_ready=least)


def _until_driving(observed: Observed) -> list[float]:
    """Return the seconds to wait for each pod that was claimed just now.

    Pods that are active, have ended or have had their time do not count. The result is empty if another robot waits for
    a replacement.
    """
    if observed.waiting:
        return []
    waits = [
        claimed + FIRST_THE_CLAIMED - observed.now
        for pod in observed.pods
        if (claimed := whole_number(kube_objects.notes(pod).get(names.CLAIMED_AT, ""))) is not None
        and kube_objects.alive(pod)
        and kube_objects.uid(pod) not in observed.active
    ]
    # The clock of another machine may put a claim into the future. No wait is longer than the maximum.
    return [min(FIRST_THE_CLAIMED, wait) for wait in waits if wait > 0]


def claimable_now(held: Sequence[Object], policy: Object | None) -> list[Object]:
    """Return the held pods that can be claimed now: ready, and of the template in the pool's network policy."""
    allowed = claimable_hash(policy)
    return [pod for pod in held if is_claimable(pod, allowed)]


def is_claimable(pod: Object, allowed: str) -> bool:
    """Whether a pod of a shared pool is held, ready and of the template with the hash ``allowed`` (empty for any)."""
    held = claims.is_held(kube_objects.labels(pod))
    return held and kube_objects.ready(pod) and (not allowed or pod_counts.hash_of(pod) == allowed)


def claimable_hash(policy: Object | None) -> str:
    """Return the hash of the template whose pods may be claimed, from the pool's network policy; empty if unknown."""
    return kube_objects.notes(policy).get(names.TEMPLATE_HASH, "") if policy else ""
