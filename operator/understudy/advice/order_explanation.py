"""Explains an order of strategies for conditions and ``understudy recommend``."""

from __future__ import annotations

import math

from understudy.advice.strategy_order import (
    NEGLIGIBLE,
    SOON,
    Candidate,
    Order,
    RatedStrategy,
    effective_resource_usage,
    required_time,
    safety_gap,
)
from understudy.api.kinds.fallback_pool import LEVELS
from understudy.api.kinds.requirements_spec import Requirements
from understudy.trees.core.leaf import duration


def strategy_name(candidate: Candidate) -> str:
    """Return a strategy with its pool, such as ``Executing (hot)``."""
    return f"{candidate.way} ({candidate.pool})" if candidate.pool else candidate.way


def one_line(order: Order) -> str:
    """Return the order in one line, such as ``Executing (hot), Restart``."""
    return ", ".join(strategy_name(one.candidate) for one in order.chosen)


def describe_time(judged: RatedStrategy) -> str:
    """Return the expected time of a strategy and its source."""
    return f"{_time(judged.seconds.value)}, {judged.seconds.source}"


def describe_requirements(requirements: Requirements) -> str:
    """Describe the requirements, each with its field."""
    within = required_time(requirements)
    cost = {
        "Low": f"with standbys that use at most {NEGLIGIBLE:g} of a working instance's CPU",
        "Medium": "with no more standbys than required for that",
        "High": "regardless of the cost of standbys",
    }[effective_resource_usage(requirements)]
    time = "without a time limit" if within == math.inf else f"within {_time(within)} after detection"
    parts = [f"a recovery {time} ({_sooner(requirements)})", f"{cost} ({_payer(requirements)})"]
    if requirements.safety == "Medium":
        parts.append("first by an instance that runs already (safety Medium)")
    if requirements.safety == "High":
        parts.append("first by an instance that was observed to be healthy while it waited (safety High)")
    return ", ".join(parts)


def describe_choice(order: Order, judged: RatedStrategy) -> str:
    """Return the reason for the place of a strategy, or for leaving it out."""
    if judged == order.first:
        return _why_first(order)
    cost = f"{judged.cost:.2g} of a working instance's CPU"
    if judged in order.costly:
        return f"would use {cost}, but {_payer(order.requirements)} allows at most {NEGLIGIBLE:g} of it"
    if judged in order.spared:
        return f"would use {cost}, but strategies after the first may use at most {NEGLIGIBLE:g} of it"
    return "if the strategies before it fail"


def _why_first(order: Order) -> str:
    known = (
        "" if order.requirements.safety == "Low" or not order.is_safe_enough else " that meets the safety requirement"
    )
    if not order.is_fast_enough:
        return f"the fastest{known}, but slower than required"
    if effective_resource_usage(order.requirements) == "High":
        return f"the fastest{known}"
    return f"the cheapest{known} that is fast enough"


def unmet_requirements(order: Order) -> list[str]:
    """Return the requirements that cannot be met."""
    found = []
    first = order.first
    if not order.is_fast_enough:
        found.append(
            f"{_sooner(order.requirements)} requires a recovery within "
            f"{_time(required_time(order.requirements))}, but the fastest strategy "
            f"that may be the first, {strategy_name(first.candidate)}, takes {_time(first.seconds.value)} ({first.seconds.source}): "
            f"{_remedy(order)}"
        )
    if not order.is_safe_enough:
        wanted = " or ".join(name for name in reversed(LEVELS) if safety_gap(order.requirements, name) == 0)
        found.append(
            f"safety {order.requirements.safety} requires a standby that is {wanted}, but none is available: "
            "add a FallbackPool that serves the workload"
        )
    if order.requirements.safety == "High" and not order.safe_commands:
        found.append("safety High requires safe commands while no instance is active: set spec.safety in the policy")
    return found


def explain(order: Order) -> str:
    """Describe the order in a few sentences, for a condition."""
    sentences = [f"{one_line(order)}. Required: {describe_requirements(order.requirements)}"]
    sentences.append(
        f"{strategy_name(order.first.candidate)} is {describe_choice(order, order.first)} ({describe_time(order.first)})"
    )
    left_out = [f"{strategy_name(one.candidate)} {describe_choice(order, one)}" for one in order.left_out]
    if left_out:
        sentences.append(f"Left out: {'; '.join(left_out)}")
    sentences += [f"Not met: {one}" for one in unmet_requirements(order)]
    return ". ".join(sentences) + "."


def _sooner(requirements: Requirements) -> str:
    """Return the requirement that determines the time."""
    if SOON[requirements.task_criticality] < SOON[requirements.availability]:
        return f"taskCriticality {requirements.task_criticality}"
    return f"availability {requirements.availability}"


def _payer(requirements: Requirements) -> str:
    """Return the requirement that determines the cost."""
    if requirements.safety == "High":
        return "safety High"
    if requirements.task_criticality == "High":
        return "taskCriticality High"
    return f"resourceUsage {requirements.resource_usage}"


def _remedy(order: Order) -> str:
    sooner = [one for one in order.costly if one.seconds.value < order.first.seconds.value]
    if sooner:
        return f"{strategy_name(sooner[0].candidate)} would be fast enough with a higher resourceUsage"
    way = order.first.candidate.way
    if way != "Restart" and LEVELS[way].runs_in_full:
        return "check in its recoveries what takes this long, or choose a lower requirement, which allows more time"
    return "add a FallbackPool with a higher readiness that serves the workload, or choose a lower requirement, which allows more time"


def _time(seconds: float) -> str:
    return duration(float(f"{seconds:.3g}"))
