"""Determines which strategies are in force: those of the policy, those selected for the workload, or its situation's.

The settings that the operator last wrote for the monitor also serve as memory. The operator keeps their strategies while
the policy is missing or invalid, and during a recovery.
"""

from __future__ import annotations

from collections.abc import Sequence

from understudy.advice.strategy_order import Order
from understudy.api import names
from understudy.api.kinds.failure_policy import Strategy
from understudy.controller.desired import strategy_selection
from understudy.controller.observed import kube_objects, policy_reader, pool_reader, situation_strategies
from understudy.controller.observed.observation import Observed
from understudy.controller.pods import pool_pods, pool_size
from understudy.kube.client import Object


def strategies(observed: Observed) -> list[Strategy]:
    """Return the strategies in force, in order. The policy must be valid."""
    policy = observed.policy
    assert policy is not None
    found = chosen(observed)
    return policy_reader.spec(policy).strategies if found is None else found


def order(observed: Observed, name: str | None = None) -> Order | None:
    """Return the order of strategies for the workload, or None.

    It is None if the policy does not leave the order open, or is missing or invalid. ``name`` is the name of a
    situation (empty for none). By default, it is the situation in force.
    """
    policy = observed.policy
    if (
        policy is None
        or not strategy_selection.is_auto(policy)
        or policy_reader.problem(policy, observed.config_maps) is not None
    ):
        return None
    name = situation(observed) if name is None else name
    found = situation_strategies.find(policy_reader.spec(policy), name) if name else None
    # A pool that is no longer accepted keeps its pods, so a workload that already uses it may continue to do so.
    before = {choice.name for choice in observed.written_pools}
    usable = {pool: item for pool, item in observed.serving.items() if observed.refused(pool) is None or pool in before}
    requirements = found.requirements if found is not None else None
    return strategy_selection.order(policy, observed.workload, usable, requirements=requirements)


def chosen(observed: Observed) -> list[Strategy] | None:
    """Return the strategies that were selected for the workload or its situation; None if its policy lists them.

    The current strategies stay while the policy is missing or invalid. They also stay during a recovery, which
    identifies a strategy by its position in the order. They may change between two failed recoveries, because the change
    may help the next one.
    """
    policy = observed.policy
    if policy is not None and not strategy_selection.varies(policy):
        return None
    settings = observed.written_settings
    present = settings.strategies if settings is not None else None
    if policy is None or (present and observed.written_recovering):
        return present
    found = _of_situation(observed, policy, situation(observed))
    return present if found is None else found


def counted_on(observed: Observed, chosen: Sequence[Strategy]) -> set[str]:
    """Return the pools of the strategies in force.

    With situations, these include the pools of the situation that the monitor was last given, and of the one that it
    reports.
    """
    found = set(named_pools(chosen))
    policy = observed.policy
    if policy is not None and situation_strategies.has_some(policy):
        for name in {_known_situation(observed, policy), situation_strategies.asked(observed.workload, policy)}:
            found |= set(named_pools(_of_situation(observed, policy, name) or []))
    return found


def named_pools(strategies: Sequence[Strategy]) -> list[str]:
    """Return the pools from which strategies take instances, in order."""
    return list(dict.fromkeys(one.pool_ref.name for one in strategies if one.pool_ref is not None))


# -- situations of the robot ---------------------------------------------------------------------------------------


def situation(observed: Observed) -> str:
    """Return the situation whose strategies are in force; empty for none.

    The strategies of the situation that the monitor reports come into force when the first of them can run, but not
    during a recovery.
    """
    policy = observed.policy
    if policy is None or not situation_strategies.has_some(policy):
        return ""
    known, asked = _known_situation(observed, policy), situation_strategies.asked(observed.workload, policy)
    if known == asked or _lacking(observed, policy, asked) is None:
        return asked
    return known


def lacking(observed: Observed) -> str:
    """Return why the strategies of the reported situation are not in force yet.

    The text is empty if they are, or if the policy has no situations.
    """
    policy = observed.policy
    if policy is None or not situation_strategies.has_some(policy):
        return ""
    return _lacking(observed, policy, situation_strategies.asked(observed.workload, policy)) or ""


def _known_situation(observed: Observed, policy: Object) -> str:
    """Return the situation whose strategies the monitor was last given."""
    settings = observed.written_settings
    return situation_strategies.known(policy, settings.situation if settings is not None else None)


def _of_situation(observed: Observed, policy: Object, name: str) -> list[Strategy] | None:
    """Return the strategies of a situation (empty for none), or None if the policy is invalid."""
    if strategy_selection.is_auto(policy):
        found = order(observed, name)
        return strategy_selection.strategies(policy, found) if found is not None else None
    if policy_reader.problem(policy, observed.config_maps) is not None:
        return None
    spec = policy_reader.spec(policy)
    one = situation_strategies.find(spec, name)
    return one.strategies if one is not None and one.strategies else spec.strategies


def _lacking(observed: Observed, policy: Object, name: str) -> str | None:
    """Return why the first strategy of a situation cannot run now, or None.

    Strategies that can never run are skipped.
    """
    if observed.written_recovering:
        return "a recovery is in progress"
    asked = _of_situation(observed, policy, name)
    if asked is None:
        return "the policy is invalid"
    served = observed.serving
    sizes = {pool: pool_size.size(item) or item["spec"].get("perWorkload") for pool, item in served.items()}
    first = situation_strategies.first_kept(asked, sizes)
    if first is None or first.pool_ref is None:
        return None
    pool, least = first.pool_ref.name, 0
    if pool_reader.has_standbys(served[pool]):
        ready = [
            pod
            for pod in observed.pods
            if kube_objects.labels(pod).get(names.POOL) == pool
            and kube_objects.ready(pod)
            and kube_objects.alive(pod)
            and not kube_objects.is_active(pod, observed.gate)
        ]
    else:
        ready = pool_pods.claimable_now(observed.unclaimed.get(pool, ()), observed.held_policies.get(pool))
        if observed.refused(pool) is None:
            least = pool_reader.spec(served[pool]).kept_from(observed.workload["spec"].get("poolPriority") or 0)
    return None if len(ready) > least else f"no pod of FallbackPool {pool} is ready for it"
