"""Explains an order of strategies for conditions and ``understudy recommend``."""

from __future__ import annotations

import math

from understudy.advice.strategy_figures import PUBLISHED
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
        "Low": f"with standbys that use at most {_percent(NEGLIGIBLE)} of a working instance's CPU",
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
    cost = f"its standbys would use {_percent(judged.cost)} of a working instance's CPU"
    if judged in order.costly:
        return f"{cost}, but {_payer(order.requirements)} allows at most {_percent(NEGLIGIBLE)}"
    if judged in order.spared:
        return f"{cost}, but strategies after the first may use at most {_percent(NEGLIGIBLE)}"
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
            f"that may be the first, {strategy_name(first.candidate)}, takes {_time(first.seconds.value)} ({_source(first)}): "
            f"{_remedy(order)}"
        )
    if not order.is_safe_enough:
        wanted = " or ".join(name for name in reversed(LEVELS) if safety_gap(order.requirements, name) == 0)
        found.append(
            f"safety {order.requirements.safety} requires a standby that is {wanted}, but none is available: "
            "add a FallbackPool that serves the workload"
        )
    if order.requirements.safety == "High" and not order.safe_commands:
        found.append("requirements.safety is High, so the policy must define safe commands: set spec.safety.commands")
    return found


def explain(order: Order) -> str:
    """Describe the order in a few sentences, for a condition."""
    first = order.first
    numbered = ", ".join(f"{place}. {strategy_name(one.candidate)}" for place, one in enumerate(order.chosen, 1))
    sentences = [f"Chosen order: {numbered}", f"Required: {describe_requirements(order.requirements)}"]
    sentences.append(
        f"The first strategy is {describe_choice(order, first)} ({_time(first.seconds.value)}, {_source(first)})"
    )
    left_out = [f"{strategy_name(one.candidate)}, because {describe_choice(order, one)}" for one in order.left_out]
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


def _source(judged: RatedStrategy) -> str:
    """Return the source of a strategy's time, as text that needs no legend."""
    source = judged.seconds.source
    return "published benchmark, see docs/choosing.md" if source == PUBLISHED else source


def _percent(share: float) -> str:
    return f"{share * 100:.3g}%"


def _time(seconds: float) -> str:
    return duration(float(f"{seconds:.3g}"))
