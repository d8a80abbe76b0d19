"""Tells an order and the reasons for it, as conditions and ``understudy recommend`` show them."""

from __future__ import annotations

import math

from understudy.advice.strategy_order import NEXT_TO_NOTHING, SOON, Candidate, Judged, Order, soon, usage
from understudy.api.kinds.requirements_spec import Requirements
from understudy.trees.core.leaf import duration


def named(candidate: Candidate) -> str:
    """A strategy with its pool, such as ``Executing (hot)``."""
    return f"{candidate.way} ({candidate.pool})" if candidate.pool else candidate.way


def in_short(order: Order) -> str:
    """The order in one line, such as ``Executing (hot), Restart``."""
    return ", ".join(named(one.candidate) for one in order.chosen)


def expected(judged: Judged) -> str:
    """How soon a strategy recovers, and how that is known."""
    return f"{_time(judged.seconds.value)}, {judged.seconds.source}"


def asked(requirements: Requirements) -> str:
    """What is asked for, each part with the requirement that it is from."""
    within = soon(requirements)
    cost = {
        "Low": f"with standbys that take at most {NEXT_TO_NOTHING:g} of a working instance's CPU",
        "Medium": "with no more standbys than that takes",
        "High": "whatever its standbys take",
    }[usage(requirements)]
    time = "however long it takes" if within == math.inf else f"within {_time(within)} of the detection"
    parts = [f"a recovery {time} ({_sooner(requirements)})", f"{cost} ({_payer(requirements)})"]
    if requirements.safety == "Medium":
        parts.append("first by an instance that is up already (safety Medium)")
    if requirements.safety == "High":
        parts.append("first by an instance that was seen to be healthy while it waited (safety High)")
    return ", ".join(parts)


def why(order: Order, judged: Judged) -> str:
    """Why a strategy has its place, or none."""
    if judged == order.first:
        return _why_first(order)
    cost = f"{judged.cost:.2g} of a working instance's CPU"
    if judged in order.costly:
        return f"would take {cost}, and {_payer(order.requirements)} allows {NEXT_TO_NOTHING:g}"
    if judged in order.spared:
        return f"would take {cost}, and behind the first one come only those that take {NEXT_TO_NOTHING:g} at most"
    return "if those before it fail"


def _why_first(order: Order) -> str:
    known = "" if order.requirements.safety == "Low" or not order.safe_enough else " of those that safety asks for"
    if not order.soon_enough:
        return f"the soonest{known}, though not as soon as asked for"
    if usage(order.requirements) == "High":
        return f"the soonest{known}"
    return f"the cheapest{known} that is soon enough"


def unmet(order: Order) -> list[str]:
    """What is asked for and can't be had."""
    found = []
    first = order.first
    if not order.soon_enough:
        found.append(
            f"{_sooner(order.requirements)} asks for {_time(soon(order.requirements))}, and {named(first.candidate)}, the soonest that may "
            f"go first, needs {_time(first.seconds.value)} ({first.seconds.source}): {_way_out(order)}"
        )
    if not order.safe_enough:
        wanted = "Executing" if order.requirements.safety == "High" else "Executing or Initialized"
        found.append(
            f"safety {order.requirements.safety} asks for a standby that is {wanted}, and there is none that may be taken: "
            "add a FallbackPool that serves the workload"
        )
    if order.requirements.safety == "High" and not order.safe_commands:
        found.append(
            "safety High, and nothing says what the robot is told while no instance is in control: give the policy spec.safety"
        )
    return found


def reason(order: Order) -> str:
    """All of it in some sentences, for a condition."""
    told = [f"{in_short(order)}. Asked for: {asked(order.requirements)}"]
    told.append(f"{named(order.first.candidate)} is {why(order, order.first)} ({expected(order.first)})")
    left_out = [f"{named(one.candidate)} {why(order, one)}" for one in order.left_out]
    if left_out:
        told.append(f"Left out: {'; '.join(left_out)}")
    told += [f"Not met: {one}" for one in unmet(order)]
    return ". ".join(told) + "."


def _sooner(requirements: Requirements) -> str:
    """The requirement that asks for the sooner recovery."""
    if SOON[requirements.task_criticality] < SOON[requirements.availability]:
        return f"taskCriticality {requirements.task_criticality}"
    return f"availability {requirements.availability}"


def _payer(requirements: Requirements) -> str:
    """The requirement that says what may be spent."""
    if requirements.safety == "High":
        return "safety High"
    if requirements.task_criticality == "High":
        return "taskCriticality High"
    return f"resourceUsage {requirements.resource_usage}"


def _way_out(order: Order) -> str:
    sooner = [one for one in order.costly if one.seconds.value < order.first.seconds.value]
    if sooner:
        return f"{named(sooner[0].candidate)} would be, with a higher resourceUsage"
    if order.first.candidate.way == "Executing":
        return "see in its recoveries what takes so long, or ask for less"
    return "add a FallbackPool of a higher readiness that serves the workload, or ask for less"


def _time(seconds: float) -> str:
    return duration(float(f"{seconds:.3g}"))
