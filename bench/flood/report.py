"""The figures of failovers with and without a flood."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from bench.flood.series import GAP, Found
from bench.results import Report

LONGER = 100.0
"""Most milliseconds that a flood may add to a failover."""

HARMLESS = {"True", "Unknown"}
"""Statuses of SoleDriver and GateEnforced while nothing is wrong. Right after a failover there is no standby to test the gate with."""

MEMORY = 1000.0
"""MB that a container may have used. Its limit is 1Gi."""


def add(report: Report, quiet: Found, floods: Mapping[str, Found], bounded: Collection[str]) -> None:
    """Add the figures of all variants. ``quiet`` is without a flood, ``bounded`` are the variants that must hold the bounds."""
    for name, found in {"no flood": quiet, **floods}.items():
        must = {"max": 0.0} if found is quiet or name in bounded else None
        _times(report, name, found, quiet, LONGER if name in bounded else None)
        for (figure, unit), values in found.rates.items():
            report.figure(f"{name}: {figure}", values, unit=unit)
        for container, values in found.memory.items():
            report.figure(f"{name}: memory of {container}", values, unit="MB", must={"max": MEMORY})
        counts = {
            "false failovers": len(found.unasked),
            "failovers that ended differently": len(found.wrong),
            "restarts of monitor, agents and discovery server": sum(found.restarts.values()),
            "commands of a standby before the switch": found.leaks,
            "conditions that were false": sum(key.split()[1] not in HARMLESS for key in found.conditions),
        }
        for figure, count in counts.items():
            report.figure(f"{name}: {figure}", [count], unit="", must=must)
        for figure, texts in (("false failovers", found.unasked), ("failovers that ended differently", found.wrong)):
            if texts:
                report.note(f"{name}: {figure}", "; ".join(texts))
        seen = ", ".join(f"{key} ({count})" for key, count in sorted(found.conditions.items()))
        report.note(f"{name}: conditions, once a second", seen)


def _times(report: Report, name: str, found: Found, quiet: Found, most: float | None) -> None:
    for figure, values in found.values.items():
        report.figure(f"{name}: {figure}", values, unit="ms")
        if found is not quiet and figure in (GAP, "t_recovery") and figure in quiet.values:
            for word, pick in (("longest", max), ("median", _median)):
                longer = [pick(values) - pick(quiet.values[figure])]
                must = None if most is None else {"max": most}
                report.figure(f"{name}: {figure}, {word} with minus {word} without", longer, unit="ms", must=must)


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
