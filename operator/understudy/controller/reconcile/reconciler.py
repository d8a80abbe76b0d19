"""Brings one object to its desired state: observe, plan, write, report. Reconciling repeatedly does no harm."""

from __future__ import annotations

import dataclasses
import logging
import secrets
import time
from collections.abc import Sequence

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.api.conditions import Condition
from understudy.controller.desired import node_drain, workload_objects
from understudy.controller.desired.workload_plan import WorkloadPlan, evaluate, probe_template
from understudy.controller.observed import dependency_graph, kube_objects, policy_reader, tree_verdicts
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import UNANSWERED, Images, Problem
from understudy.controller.pods import claim_tokens, instance_pod, pool_pods, pool_size
from understudy.controller.reconcile import change_index, in_place_resize, operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import MANAGER, Executor
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.reconcile.template_validation import FORGET_REFUSAL, Judge
from understudy.controller.reconcile.tree_judge import TreeJudge
from understudy.controller.status import policy_map_room, policy_status, pool_status, storm_detection, workload_status
from understudy.kube.client import (
    CONFIG_MAPS,
    PODS,
    POLICIES,
    POOLS,
    SECRETS,
    WORKLOADS,
    ApiError,
    Client,
    Object,
    Resource,
)
from understudy.kube.events import Recorder
from understudy.kube.undeclared_fields import apply_declared, lacking

_logger = logging.getLogger(__name__)

_ALPHABET = "bcdfghjklmnpqrstvwxz2456789"  # as in Kubernetes' generated names: letters that form no words
ABSENT = frozenset(
    {
        "PolicyNotFound",
        "DependencyNotFound",
        "PoolNotFound",
        "NoPool",
        "PoolDoesNotServe",
        "NoMatchingWorkload",
        "ReferenceNotFound",
        "TemplateSourceNotFound",
        "RequirementsNotMet",
    }
)
"""Reasons for a missing object."""
TOGETHER_SECONDS = 3.0
"""Seconds after an object's creation during which missing objects are not reported yet."""

COUNT_SECONDS = 1.0
"""Minimum time, in seconds, between two writes of a pool's status.

In a burst the status changes with every claim, which would load the API server. The status for a new spec is written at
once.
"""

WITHDRAWN = frozenset(
    {
        in_place_resize.CONDITION,
        workload_status.CHOSEN,
        node_drain.CONDITION,
        pool_size.CONDITION,
        pool_pods.MOVING,
        dependency_graph.RESOLVED,
        storm_detection.CONDITION,
        policy_map_room.CONDITION,
    }
)
"""Conditions that are removed if they have nothing to report."""

_RESOURCES = {resource.plural: resource for resource in (WORKLOADS, POLICIES, POOLS)}


def fresh() -> pool_pods.UniqueValues:
    """Return the source of random pod names and agent tokens."""
    return pool_pods.UniqueValues(
        name=lambda prefix: f"{prefix}-{''.join(secrets.choice(_ALPHABET) for _ in range(5))}",
        token=lambda: secrets.token_hex(32),
    )


class Reconciler:
    """Reconciles keys of all three kinds, and restores the labels of instances."""

    def __init__(
        self,
        client: Client,
        store: Store,
        observer: Observer,
        executor: Executor,
        recorder: Recorder,
        images: Images,
        rollouts: Rollouts,
        trees: TreeJudge | None = None,
    ) -> None:
        """Without ``trees``, the trees of an object are checked while it is reconciled, which may take long."""
        self._client, self._store, self._observer, self._executor = client, store, observer, executor
        self._recorder, self._images, self._judge = recorder, images, Judge(client)
        self._rollouts = rollouts
        self.trees = trees
        self._fresh = fresh()
        self._counted: dict[Key, float] = {}
        """Time of the last write of each pool's status, in seconds of the monotonic clock."""
        self._unknown: set[str] = set()
        """Status fields that the installed CRDs lack."""

    async def reconcile(self, key: Key) -> float | None:
        """Reconcile the object, and return the seconds until it must be reconciled again, or None.

        An object with a tree that was not checked yet is left as it is until then. Raises what :meth:`Executor.run` raises.
        """
        if self.trees is None:
            return await self._reconcile(key)
        try:
            with tree_verdicts.looked_up(self.trees.find):
                return await self._reconcile(key)
        except tree_verdicts.Unjudged as missing:
            self.trees.submit(missing.tree, key)
            return None

    async def _reconcile(self, key: Key) -> float | None:
        if key.plural == PODS.plural:
            await self._restore_labels(key)
            return None
        item = self._store.get(_RESOURCES[key.plural], key.namespace, key.name)
        if key.plural == WORKLOADS.plural:
            return await self._workload(key, item)
        if item is None or kube_objects.deleted(item):
            if key.plural == POOLS.plural:
                await self._without_pool(key, item)
            if key.plural == POLICIES.plural:
                operator_metrics.storm(key.namespace, key.name, None)
            return None
        if key.plural == POOLS.plural:
            return await self._pool(key, item)
        return await self._policy(item)

    async def _workload(self, key: Key, item: Object | None) -> float | None:
        if item is None or kube_objects.deleted(item):
            pods = self._store.labelled(PODS, key.namespace, names.WORKLOAD, key.name)
            await self._executor.run(key, workload_objects.abandoned(key.name, pods).writes)
            self._rollouts.forget(key)
            if item is None:
                self._executor.forget(key)
            return None
        observed = await self._observer.workload(item)
        workload_plan = evaluate(observed, self._images)
        try:
            return await self._build(key, observed, workload_plan)
        except ApiError as error:
            if (problem := _unanswered(error)) is not None:
                resized = in_place_resize.judged(in_place_resize.outcomes(observed, workload_plan))
                await self._write_status(
                    WORKLOADS, item, workload_status.status(observed, workload_plan, [problem], resized)
                )
            raise

    async def _restore_labels(self, key: Key) -> None:
        """Restore the labels of an instance, while the reconciliation of its workload may wait for something else.

        That one reports a refusal, because it restores them too.
        """
        pod = self._store.get(PODS, key.namespace, key.name)
        workload = self._store.get(WORKLOADS, key.namespace, change_index.workload_of(pod)) if pod is not None else None
        if pod is None or workload is None or kube_objects.deleted(workload):
            return
        await self._executor.run(key, workload_objects.labels(self._observer.instance(workload, pod), WorkloadPlan()))

    async def _build(self, key: Key, observed: Observed, workload_plan: WorkloadPlan) -> float | None:
        again = None
        if (pod := probe_template(observed, workload_plan)) is not None:
            path = "spec.template" if observed.reference is None else "the referred controller's spec.template"
            refusal = await self._judge.judge(pod, path)
            if refusal is not None:
                workload_plan = dataclasses.replace(workload_plan, problem=refusal)
                again = FORGET_REFUSAL
        plan = workload_objects.plan(observed, workload_plan, self._images, self._fresh)
        writes, turn = self._rollouts.admitted(key, plan.writes)
        problems = await self._executor.run(key, writes)
        raised = await self._resize(key, observed, workload_plan)
        if problems or any(one.reason == "Refused" for one in raised):
            again = FORGET_REFUSAL
        observed = self._with_written_objects(observed)
        status = workload_status.status(observed, workload_plan, problems, in_place_resize.judged(raised))
        return _earliest(plan.again_after, again, turn, await self._write_status(WORKLOADS, observed.workload, status))

    async def _resize(
        self, key: Key, observed: Observed, workload_plan: WorkloadPlan
    ) -> list[in_place_resize.ResizeOutcome]:
        """Resize the active pod as requested. A refusal of the API server does not affect the other writes."""
        found = []
        for outcome in in_place_resize.outcomes(observed, workload_plan):
            writes = [outcome.write] if outcome.write is not None else []
            problems = await self._executor.run(key, writes)
            found.append(in_place_resize.refused(outcome, problems[0]) if problems else outcome)
        return found

    def _with_written_objects(self, observed: Observed) -> Observed:
        """Return the observed state with the objects just written, so that the status is not one step behind."""
        return dataclasses.replace(observed, owned=self._store.owned(kube_objects.uid(observed.workload)))

    async def _pool(self, key: Key, item: Object) -> float | None:
        observed = await self._observer.pool(item)
        pool_plan = pool_pods.evaluate(observed, self._images)
        try:
            return await self._keep(key, observed, pool_plan)
        except ApiError as error:
            if (problem := _unanswered(error)) is not None:
                await self._count(key, item, pool_status.status(observed, pool_plan, [problem]))
            raise  # The queue then tries again, and the status is written if it was postponed.

    async def _keep(self, key: Key, observed: pool_pods.Observed, pool_plan: pool_pods.PoolPlan) -> float | None:
        item, again = observed.pool, None
        if pool_plan.built is not None:
            trial = instance_pod.trial(pool_plan.built, "FallbackPool", item)
            refusal = await self._judge.judge(trial, "the pool's template")
            if refusal is not None:
                pool_plan = dataclasses.replace(pool_plan, problem=refusal, built=None)
                again = FORGET_REFUSAL
        plan = pool_pods.plan(observed, pool_plan, self._fresh)
        problems = await self._executor.run(key, plan.writes)
        if problems:
            again = FORGET_REFUSAL
        observed_now = dataclasses.replace(
            observed,
            owned=self._store.owned(kube_objects.uid(item)),
            pods=self._store.labelled(PODS, key.namespace, names.POOL, key.name),
        )
        later = await self._count(key, item, pool_status.status(observed_now, pool_plan, problems))
        self._measure(key, pool_plan.sized)
        if pool_plan.sized is not None and (change := pool_size.change(pool_plan.sized)) is not None:
            await self._recorder.normal(item, "Resized", change)
        return _earliest(plan.again_after, again, later)

    async def _without_pool(self, key: Key, item: Object | None) -> None:
        """Do what remains for a pool that is deleted or being deleted: pods that were claimed from it keep running."""
        self._measure(key, None)
        self._counted.pop(key, None)
        pods = self._store.labelled(PODS, key.namespace, names.POOL, key.name)
        writes = claim_tokens.outlast(
            key.name,
            key.namespace,
            self._store.get(SECRETS, key.namespace, names.pool_secret(key.name)),
            deleted=item is not None,
            pods=pods,
            workloads=self._store.in_namespace(WORKLOADS, key.namespace),
            token=self._fresh.token,
        )
        for problem in await self._executor.run(key, writes):
            _logger.warning("FallbackPool %s/%s is gone: %s", key.namespace, key.name, problem.message)
        # As long as it has pods, it is reconciled with each of their changes and with every list. Each time, objects
        # with the same name prefix would be forgotten too.
        if item is None and not pods:
            self._executor.forget(key)

    def _measure(self, key: Key, sized: pool_size.Sized | None) -> None:
        """Set the metrics of a pool's size; remove them if its size does not follow the failure rate."""
        figures = (operator_metrics.POOL_SIZE, operator_metrics.POOL_NEEDED, operator_metrics.POOL_FAILURES)
        if sized is None:
            for gauge in figures:
                gauge.remove(key.namespace, key.name)
            return
        values = (sized.decision.size, sized.decision.needed, sized.rate.expected)
        for gauge, value in zip(figures, values, strict=True):
            gauge.labels(key.namespace, key.name).set(value)

    async def _policy(self, item: Object) -> float | None:
        namespace, name = item["metadata"]["namespace"], kube_objects.name(item)
        users = [key.name for key in change_index.users(name, self._store, namespace)]
        found = self._store.in_namespace(POOLS, namespace)
        config_maps = self._store.in_namespace(CONFIG_MAPS, namespace)
        storm, again = self._storm(item, users)
        status = policy_status.status(item, pools=found, config_maps=config_maps, users=users, storm=storm)
        return _earliest(again, await self._write_status(POLICIES, item, status))

    def _storm(self, policy: Object, users: Sequence[str]) -> tuple[Condition | None, float | None]:
        """Return the condition for storms, and the seconds until the next check; None if the policy has no storm guard."""
        guard, namespace = policy_reader.storm_guard(policy), policy["metadata"]["namespace"]
        if guard is None:
            operator_metrics.storm(namespace, kube_objects.name(policy), None)
            return None, None
        found = self._store.in_namespace(WORKLOADS, namespace)
        fleet = [(found[name], self._store.gate(found[name])) for name in users]
        condition, again = storm_detection.judge(policy, guard, fleet, time.time())
        operator_metrics.storm(namespace, kube_objects.name(policy), condition.status == "True")
        return condition, again

    async def _count(self, key: Key, pool: Object, status: Object) -> float | None:
        """Write a pool's status like :meth:`_write_status`, but at most once in COUNT_SECONDS."""
        now = time.monotonic()
        wait = self._counted.get(key, now - COUNT_SECONDS) + COUNT_SECONDS - now
        stored = pool.get("status") or {}
        if _says(pool, status):
            return None
        if wait > 0 and stored.get("observedGeneration") == status["observedGeneration"]:
            return wait
        later = await self._write_status(POOLS, pool, status)
        self._counted[key] = now
        return later

    async def _write_status(self, resource: Resource, item: Object, status: Object) -> float | None:
        """Write the status if it differs from the stored one, and report transitions as Events.

        Returns the seconds until the next attempt if it is too early to report something.
        """
        if _says(item, status):
            return None
        if _too_early(item, status):
            return TOGETHER_SECONDS
        timed = workload_status.timed(item, status)
        metadata = item["metadata"]
        body = {
            "apiVersion": API_VERSION,
            "kind": item["kind"],
            "metadata": {key: metadata[key] for key in ("name", "namespace", "uid")},
            "status": timed,
        }
        self._executor.check()
        operator_metrics.WRITES.labels(resource.plural, "status").inc()
        try:
            made, unknown = await apply_declared(
                self._client, resource, metadata["namespace"], body, manager=MANAGER, subresource="status"
            )
        except ApiError as error:
            if error.not_found or error.conflict:  # it was deleted meanwhile
                return None
            raise
        if new := set(unknown) - self._unknown:
            self._unknown |= new
            _logger.warning("%s", lacking(resource, new, "operator"))
        self._store.put(resource, made)
        await self._announce(item, workload_status.transitions(item, status))
        return None

    async def _announce(self, item: Object, transitions: Sequence[Object]) -> None:
        for found in transitions:
            reason = found["reason"] if found["status"] == "False" else found["type"]
            if (found["status"] == "False") != (found["type"] == storm_detection.CONDITION):
                await self._recorder.warning(item, reason, f"{found['type']}: {found['message']}")
            else:
                await self._recorder.normal(item, reason, found["message"])


def _unanswered(error: ApiError) -> Problem | None:
    """Return the problem of an admission webhook that does not answer. Its text is the same for each attempt."""
    if not error.webhook:
        return None
    return Problem(
        UNANSWERED,
        f'The admission webhook "{error.webhook}" does not answer, so the API server rejects every write that the webhook must review '
        "(failurePolicy Fail). The operator retries until it answers. Repair the webhook, or exclude this namespace from it",
    )


def _says(item: Object, status: Object) -> bool:
    """Whether the stored status already says the same, regardless of its transition times."""
    live = item.get("status") or {}
    stored = {c["type"]: c for c in live.get("conditions") or []}
    if WITHDRAWN & stored.keys() - {new["type"] for new in status["conditions"]}:
        return False
    for new in status["conditions"]:
        old = stored.get(new["type"])
        if old is None or any(old.get(k) != v for k, v in new.items() if k != "lastTransitionTime"):
            return False
    return all(live.get(key) == value for key, value in status.items() if key != "conditions")


def _too_early(item: Object, status: Object) -> bool:
    """Whether a missing object may follow shortly: objects that belong together are created one by one."""
    age = time.time() - kube_objects.created(item)
    return 0 <= age < TOGETHER_SECONDS and any(c["reason"] in ABSENT for c in status["conditions"])


def _earliest(*delays: float | None) -> float | None:
    found = [delay for delay in delays if delay is not None]
    return min(found) if found else None
