"""Checks references between the objects of the given files. Missing objects may be in the cluster, so these are warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from understudy.advice import order_explanation
from understudy.api.kinds.failure_policy import Monitoring
from understudy.api.kinds.fallback_pool import has_standbys, is_shared
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.config_map_trees import IN_THE_CLUSTER, missing
from understudy.cli.manifests.manifest_reader import Manifest, at, items
from understudy.controller.desired import strategy_selection
from understudy.controller.observed import dependency_graph
from understudy.controller.status.policy_status import shared, unshared
from understudy.failover import availability
from understudy.failover.availability import Pool, Resources
from understudy.kube import selectors
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.source.problems import TreeError

_MOST_SHOWN = 5


def check(manifests: Sequence[Manifest]) -> Iterator[Finding]:
    """Yield references and selectors without a target, workloads that no pool of their policy serves, and what is given twice."""
    yield from _twice(manifests)
    workloads, policies, pools = (
        [one for one in manifests if one.kind == kind] for kind in ("RobotWorkload", "FailurePolicy", "FallbackPool")
    )
    for workload in workloads:
        name = at(workload.data, "spec", "failurePolicyRef", "name")
        yield from missing(workload, "spec.failurePolicyRef.name", "FailurePolicy", name, policies)
        for policy in (one for one in policies if one.name == name and workload.together(one)):
            yield from _no_fallback_available(workload, policy, pools)
            yield from _requirements_not_met(workload, policy, pools)
            yield from _never_idle(workload, policy)
            yield from _outputs_not_watched(workload, policy)
        yield from _depends(workload, workloads)
    yield from _one_source(workloads)
    for policy in policies:
        for index, strategy in enumerate(items(policy.data, "spec", "strategies")):
            path, name = f"spec.strategies[{index}].poolRef.name", at(strategy, "poolRef", "name")
            yield from missing(policy, path, "FallbackPool", name, pools)
        for path, name in _situation_pools(policy):
            yield from missing(policy, path, "FallbackPool", name, pools)
        yield from _unreachable_situations(policy)
        yield from _empty_situations(policy, pools)
        yield from _not_prewarmed(policy, pools)
        yield from _wait_without_shared_pool(policy, pools)
    for pool in pools:
        name = at(pool.data, "spec", "templateFrom", "workload")
        yield from missing(pool, "spec.templateFrom.workload", "RobotWorkload", name, workloads)
        yield from _selects(pool, workloads)


def _twice(manifests: Sequence[Manifest]) -> Iterator[Finding]:
    """Report an object that is given again. In another file it is a warning, because it may be a variant of the first one."""
    first: dict[tuple[str, str, str], Manifest] = {}
    for one in manifests:
        other = first.setdefault((one.kind, one.namespace, one.name), one)
        if one.name and other is not one:
            message = (
                f"this {one.kind} is in {other.file}:{other.place('metadata.name').line} too, and the one that is applied last "
                "replaces the other; remove one of them, or give it another name"
            )
            yield one.finding("metadata.name", message, warning=one.file != other.file)


def _one_source(workloads: Sequence[Manifest]) -> Iterator[Finding]:
    """Report a workload whose pods are those of another workload already."""
    for index, one in enumerate(workloads):
        source = at(one.data, "spec", "workloadRef")
        for other in workloads[:index]:
            same = isinstance(source, Mapping) and source == at(other.data, "spec", "workloadRef")
            if same and one.together(other) and one.name != other.name:
                message = (
                    f"{source.get('kind')} {source.get('name')} is the source of RobotWorkload {other.name} ({other.file}) already, "
                    "and a pod belongs to one workload; list the outputs of both in one RobotWorkload, or give each its own pods"
                )
                yield one.finding("spec.workloadRef.name", message)
                break


def _depends(workload: Manifest, workloads: Sequence[Manifest]) -> Iterator[Finding]:
    """Report missing dependencies and dependency cycles. A cycle is an error without a cluster, too."""
    near = [one for one in workloads if workload.together(one)]
    known = {one.name: dependency_graph.named(one.data) for one in near}
    found = dependency_graph.circle(known, workload.name)
    for index, name in enumerate(known.get(workload.name, ())):
        path = f"spec.dependsOn[{index}].name"
        yield from missing(workload, path, "RobotWorkload", name, workloads)
        if (
            found is not None and len(found) > 2 and name == found[found.index(workload.name) + 1]
        ):  # the API server refuses a workload that depends on itself
            message = (
                f"{dependency_graph.drawn(found)} is a cycle, in which no workload can be recovered first; "
                "remove one of these dependencies"
            )
            yield workload.finding(path, message)


def _selects(pool: Manifest, workloads: Sequence[Manifest]) -> Iterator[Finding]:
    """Report a pool whose selector matches no workload."""
    if _selector(pool) is None or any(pool.together(one) and _serves(pool, one) for one in workloads):
        return
    shown = [f"{one.name} has {_labels(one)}" for one in workloads if pool.together(one)][:_MOST_SHOWN]
    if shown:
        there = "; ".join(shown)
        found = (
            f"matches none of the RobotWorkloads in the given files ({there}); correct it or the workload's labels, or"
        )
    else:
        found = "there is no RobotWorkload in the given files that it could match;"
    message = f"{found} give the file of the workload that it serves. {IN_THE_CLUSTER}"
    yield pool.finding("spec.workloadSelector", message, warning=True)


def _no_fallback_available(workload: Manifest, policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report a workload for which no fallback of its policy could run, if all of their pools are given."""
    strategies = items(policy.data, "spec", "strategies")
    named = {pool for one in strategies if isinstance(pool := at(one, "poolRef", "name"), str)}
    pools_by_name = {pool.name: pool for pool in pools if pool.name in named and workload.together(pool)}
    if not named or set(pools_by_name) != named or any(_selector(pool) is None for pool in pools_by_name.values()):
        return
    there = Resources({name: _pool(pool, workload) for name, pool in pools_by_name.items()})
    found = [availability.fallback(name, there) for name in sorted(named)]
    if not any(one.available for one in found):
        message = (
            f"found {_labels(workload)}, with which no fallback of FailurePolicy {policy.name} could run: "
            f"{'; '.join(one.message for one in found)}"
        )
        yield workload.finding("metadata.labels", message, warning=True)


def _pool(pool: Manifest, workload: Manifest) -> Pool:
    """Return what a workload could use from a pool. Files do not say how many pods are ready, so one is assumed."""
    readiness = at(pool.data, "spec", "readiness")
    return Pool(readiness if isinstance(readiness, str) else "", serves=_serves(pool, workload), ready=1)


def _requirements_not_met(workload: Manifest, policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report requirements that the pools of a workload cannot meet, if the policy chooses its strategies automatically."""
    if not strategy_selection.is_auto(policy.data):
        return
    serving = {pool.name: pool.data for pool in pools if workload.together(pool) and _serves(pool, workload)}
    order = strategy_selection.order(policy.data, workload.data, serving)
    if order is None:
        return
    # A pool in the cluster may meet what the pools of these files do not.
    hint = "" if order.is_fast_enough and order.is_safe_enough else f". {IN_THE_CLUSTER}"
    for problem in order_explanation.unmet_requirements(order):
        message = f"for RobotWorkload {workload.name}, the chosen order is {order_explanation.one_line(order)}: {problem}{hint}"
        yield policy.finding("spec.requirements", message, warning=True)


def _never_idle(workload: Manifest, policy: Manifest) -> Iterator[Finding]:
    """Report a policy that reschedules at idle times although nothing defines when the workload is idle."""
    if items(workload.data, "spec", "tasks"):
        return
    for index, action in enumerate(items(policy.data, "spec", "degraded", "actions")):
        if isinstance(found := at(action, "reschedule"), Mapping) and not found.get("idle"):
            message = (
                f"FailurePolicy {policy.name} replaces a degraded instance only while the robot is idle (reschedule), but nothing "
                f"defines when this workload is idle, so it never does: set spec.tasks, or in the policy "
                f"spec.degraded.actions[{index}].reschedule.idle"
            )
            yield workload.finding("spec.tasks", message, warning=True)


def _outputs_not_watched(workload: Manifest, policy: Manifest) -> Iterator[Finding]:
    """Report a tree that evaluates messages only and none of the outputs: most often a name is misspelled."""
    outputs = [topic for one in items(workload.data, "spec", "outputs") if isinstance(topic := at(one, "topic"), str)]
    if (tree := _tree(policy)) is None:
        return
    watched = [topic.name for topic in tree.topics]
    if outputs and all(leaf.uses_messages for leaf in tree.leaves) and not set(outputs) & set(watched):
        message = (
            f"watches {_some(watched)}, but none of the outputs of RobotWorkload {workload.name} ({_some(outputs)}), so the failure of an "
            "output is not detected; watch one of them, or correct the names"
        )
        yield policy.finding("spec.monitoring", message, warning=True)


def _tree(policy: Manifest) -> HealthTree | None:
    """Return the health tree of a policy; None if it is elsewhere or cannot be loaded, which another check reports."""
    monitoring = at(policy.data, "spec", "monitoring")
    if at(monitoring, "configMapKeyRef") is not None:
        return None
    try:
        return load_monitoring(Monitoring.model_validate(monitoring))
    except (ValidationError, TreeError):
        return None


def _situation_pools(policy: Manifest) -> Iterator[tuple[str, Any]]:
    """Yield the paths at which strategies of situations name a pool, and the names."""
    for index, situation in enumerate(items(policy.data, "spec", "situations")):
        for place, strategy in enumerate(items(situation, "strategies")):
            name = at(strategy, "poolRef", "name")
            yield f"spec.situations[{index}].strategies[{place}].poolRef.name", name


def _unreachable_situations(policy: Manifest) -> Iterator[Finding]:
    """Report a situation with the same condition as an earlier one: it never applies."""
    before: list[tuple[str, Any]] = []
    for index, situation in enumerate(items(policy.data, "spec", "situations")):
        name, when = str(at(situation, "name") or ""), at(situation, "when")
        first = next((other for other, known_by in before if known_by == when), None)
        if when and first is not None:
            message = (
                f"is the same as that of the situation {first}, which comes first, so this situation never applies; change the "
                f"condition, or merge the two"
            )
            yield policy.finding(f"spec.situations[{index}].when", message, warning=True)
        before.append((name, when))


def _empty_situations(policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report situations that use a pool with perWorkload 0, which never has a standby."""
    near = {one.name: one.data for one in pools if policy.together(one)}
    for path, name in _situation_pools(policy):
        spec = at(near, name, "spec")
        if has_standbys(at(spec, "readiness")) and at(spec, "perWorkload") == 0:
            message = (
                f"FallbackPool {name} has perWorkload 0, so it has no standby in this situation either; set perWorkload: 1. "
                f"Standbys exist only while the applicable strategies name their pool"
            )
            yield policy.finding(path, message, warning=True)


def _not_prewarmed(policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report a pre-warmed pool that is shared: its pods belong to no workload."""
    kinds = {one.name: at(one.data, "spec", "readiness") for one in pools if policy.together(one)}
    for index, action in enumerate(items(policy.data, "spec", "degraded", "actions")):
        name = at(action, "prewarm", "poolRef", "name")
        if isinstance(name, str) and is_shared(kinds.get(name)):
            yield policy.finding(f"spec.degraded.actions[{index}].prewarm.poolRef.name", shared(name))


def _wait_without_shared_pool(policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report waitFor with a pool that is not shared."""
    kinds = {one.name: at(one.data, "spec", "readiness") for one in pools if policy.together(one)}
    for index, strategy in enumerate(items(policy.data, "spec", "strategies")):
        readiness = kinds.get(at(strategy, "poolRef", "name"))
        if at(strategy, "waitFor") is not None and has_standbys(readiness):
            name = at(strategy, "poolRef", "name")
            yield policy.finding(f"spec.strategies[{index}].waitFor", unshared(name, str(readiness)), warning=True)


def _serves(pool: Manifest, workload: Manifest) -> bool:
    selector = _selector(pool)
    return selector is not None and selectors.matches(selector, workload.labels)


def _selector(pool: Manifest) -> Mapping[str, Any] | None:
    """Return a pool's selector; None if it is invalid, which another check reports."""
    found = at(pool.data, "spec", "workloadSelector")
    if not isinstance(found, Mapping):
        return None
    labels, expressions = found.get("matchLabels") or {}, found.get("matchExpressions") or []
    if not isinstance(labels, Mapping) or not isinstance(expressions, list):
        return None
    for one in expressions:
        if (
            not isinstance(one, Mapping)
            or not isinstance(one.get("key"), str)
            or not isinstance(one.get("operator"), str)
        ):
            return None
        if not isinstance(one.get("values") or [], list):
            return None
    return found


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_SHOWN} more" if len(names) > _MOST_SHOWN else ""
    return ", ".join(names[:_MOST_SHOWN]) + more


def _labels(workload: Manifest) -> str:
    listed = ", ".join(f"{key}={value}" for key, value in list(workload.labels.items())[:_MOST_SHOWN])
    return f"labels {listed}" if listed else "no labels"
