"""Explains a workload's health from its conditions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from understudy.api.conditions import Condition

_PLAIN: Mapping[str, str] = {
    "Starting": "no instance has been healthy yet",
    "Degraded": "it is degraded",
    "Failed": "it has failed",
    "Recovering": "it is being recovered",
    "Unknown": "the health is unknown: no policy is in effect, or no instance is running",
}

PAST = ("Recovered", "HealthyAgain", "Superseded")
"""Reasons of the condition Recovering that refer to a recovery that has ended."""


def why(health: str, active: str, conditions: Iterable[Condition]) -> str:
    """Return why the health is what it is. ``active`` is the name of the active pod."""
    if health == "Healthy":
        return f"{active} is in control" if active else "healthy"
    found = decisive(health, active, conditions)
    return found.message if found is not None else _PLAIN.get(health, health)


def decisive(health: str, active: str, conditions: Iterable[Condition]) -> Condition | None:
    """Return the condition that explains why a workload is not healthy, or None."""
    found = {condition.type: condition for condition in conditions}
    degraded, recovering, judged = found.get("Degraded"), found.get("Recovering"), found.get("Healthy")
    held = found.get("DependencyFailed")
    if health == "Failed" and held is not None and held.status == "True":
        return held
    if health == "Degraded" and degraded is not None and degraded.status == "True":
        return degraded
    if health in ("Failed", "Recovering") and recovering is not None and recovering.reason not in PAST:
        return recovering
    # Without an active instance, the condition Healthy is about one that is gone.
    if health != "Unknown" and active and judged is not None and judged.status != "True" and judged.message:
        return judged
    return None
