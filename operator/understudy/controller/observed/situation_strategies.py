"""Determines the strategies for the robot's situation, from objects of the API.

The monitor reports the situation. The strategies change when the first strategy of the new situation can run. The old
strategies are given up only after the monitor has received the change. Until then the pods of both stay, so that the
robot is protected at every moment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.kinds.failure_policy import FailurePolicySpec, Situation, Strategy
from understudy.kube.client import Object

CONDITION = "SituationCovered"
"""The condition that reports whether the strategies of the current situation are in force."""


def has_some(policy: Object) -> bool:
    """Whether a policy has situations. Most policies have none, so nothing is parsed."""
    return bool(_listed(policy))


def asked(workload: Object, policy: Object) -> str:
    """Return the situation that the monitor reports, if the policy has it; empty otherwise."""
    reported = ((workload.get("status") or {}).get("situation") or {}).get("name", "")
    return known(policy, reported)


def known(policy: Object, name: str | None) -> str:
    """Return the name of a situation if the policy has it; empty otherwise."""
    found = any(isinstance(one, Mapping) and one.get("name") == name for one in _listed(policy))
    return name if name and found else ""


def find(spec: FailurePolicySpec, name: str) -> Situation | None:
    """Return a situation by its name, or None."""
    return next((one for one in spec.situations if one.name == name), None)


def named_pools(policy: Object) -> list[str]:
    """Return the pools that the strategies of a policy's situations name, in order."""
    return [name for _, name in pool_paths(policy)]


def pool_paths(policy: Object) -> list[tuple[str, str]]:
    """Return the pools that :func:`named_pools` names, each with the path of its field."""
    return [
        (f"spec.situations[{i}].strategies[{j}].poolRef.name", name)
        for i, situation in enumerate(_listed(policy))
        for j, strategy in enumerate(situation.get("strategies") or [])
        if (name := (strategy.get("poolRef") or {}).get("name"))
    ]


def description(asked: str, in_force: str, order: str, lacking: str) -> tuple[str, str]:
    """Return reason and message of the condition.

    ``order`` is the strategies in force, and ``lacking`` is why they belong to another situation.
    """
    if asked == in_force:
        if asked:
            return "InForce", f"The robot is in situation {asked}. Strategies in effect: {order}."
        return "NoSituation", f"The robot is in no situation of its policy. Strategies in effect: {order}."
    what, whose = f"The robot is in situation {asked}", "its"
    if not asked:
        what, whose = f"Situation {in_force} ended", "the policy's own"
    message = f"{what}. Until {whose} first strategy is available, the strategies stay {order}: {lacking}."
    return "StandbyNotReady", message


def first_kept(strategies: Sequence[Strategy], kept: Mapping[str, Any]) -> Strategy | None:
    """Return the first strategy that can ever run: it needs no pool, or ``kept`` has a number of pods for its pool."""
    return next((one for one in strategies if one.pool_ref is None or kept.get(one.pool_ref.name)), None)


def _listed(policy: Object) -> list[Any]:
    found = (policy.get("spec") or {}).get("situations")
    return found if isinstance(found, list) else []
