"""Which strategies are in force by the robot's situation, from objects as they are. In which situation it is the monitor says.

What is in force changes when the first strategy of what is asked for could be carried out, and what was in force is let go only
after the monitor was told: until then all of it stays, so that there is no moment without protection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.kinds.failure_policy import FailurePolicySpec, Situation, Strategy
from understudy.kube.client import Object

CONDITION = "SituationCovered"
"""The condition that says whether the strategies of the present situation are in force."""


def has_some(policy: Object) -> bool:
    """Whether a policy has situations. Nothing is parsed for the many that have none."""
    return bool(_listed(policy))


def asked(workload: Object, policy: Object) -> str:
    """The situation that the monitor says, as far as the policy has it; empty for none."""
    said = ((workload.get("status") or {}).get("situation") or {}).get("name", "")
    return known(policy, said)


def known(policy: Object, name: str | None) -> str:
    """The name of a situation, where the policy has it; else empty."""
    found = any(isinstance(one, Mapping) and one.get("name") == name for one in _listed(policy))
    return name if name and found else ""


def find(spec: FailurePolicySpec, name: str) -> Situation | None:
    """A situation by its name; None where there is none."""
    return next((one for one in spec.situations if one.name == name), None)


def named_pools(policy: Object) -> list[str]:
    """The pools that the strategies of a policy's situations name, in order."""
    return [name for _, name in pool_paths(policy)]


def pool_paths(policy: Object) -> list[tuple[str, str]]:
    """These, each with the path at which it is named."""
    return [
        (f"spec.situations[{i}].strategies[{j}].poolRef.name", name)
        for i, situation in enumerate(_listed(policy))
        for j, strategy in enumerate(situation.get("strategies") or [])
        if (name := (strategy.get("poolRef") or {}).get("name"))
    ]


def told(asked: str, in_force: str, order: str, lacking: str) -> tuple[str, str]:
    """What is said of it: the reason of the condition, and the message. ``order`` is in force, and ``lacking`` why it is another's."""
    if asked == in_force:
        if asked:
            return "InForce", f"The robot is in situation {asked}. Strategies in effect: {order}."
        return "NoSituation", f"The robot is in no situation of its policy. Strategies in effect: {order}."
    what, whose = f"The robot is in situation {asked}", "its"
    if not asked:
        what, whose = f"Situation {in_force} ended", "the policy's own"
    told = f"{what}. Until {whose} first strategy is available, the strategies stay {order}: {lacking}."
    return "StandbyNotReady", told


def first_kept(strategies: Sequence[Strategy], kept: Mapping[str, Any]) -> Strategy | None:
    """The first of the strategies that may ever be carried out, with the pools that serve the workload and are to have something."""
    return next((one for one in strategies if one.pool_ref is None or kept.get(one.pool_ref.name)), None)


def _listed(policy: Object) -> list[Any]:
    found = (policy.get("spec") or {}).get("situations")
    return found if isinstance(found, list) else []
