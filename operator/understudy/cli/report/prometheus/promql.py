"""Builds the PromQL expressions for a whole period. Pure.

``increase`` alone would be wrong here. A series of a strategy begins with the first recovery by it after each start of
a monitor, so ``increase`` does not count that recovery, and most robots have few. It also extrapolates to the ends of
the period, so that counts would not be whole numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection

from understudy.cli.report.recovery_records import Span

ALIVE = "understudy_tree_evaluations_total"
"""A series that every monitor has from its start."""


def selector(namespace: str | None = None, workloads: Collection[str] = (), **labels: str) -> str:
    """Return the selector of the series; for all namespaces and workloads if none are named."""
    told = [f'{label}="{_escaped(value)}"' for label, value in labels.items()]
    if namespace is not None:
        told.insert(0, f'namespace="{_escaped(namespace)}"')
    if workloads:
        told.append(f'workload=~"{_escaped("|".join(re.escape(name) for name in sorted(workloads)))}"')
    return f"{{{','.join(told)}}}"


def came(metric: str, where: str, period: Span) -> str:
    """Return the increase of the monitors' counters in the period, by series.

    In this order: ``increase`` for a counter that was reset in its pod; the difference for a series that existed at the start of the
    period; the value for a new series whose monitor was scraped already or did not exist yet; and the difference to the first
    sample for a monitor that is older than its data.
    """
    series, ago = f"{metric}{where}", length(period)
    fresh = f"({ALIVE}{where} offset {ago} or last_over_time(process_start_time_seconds{where}[{ago}]) >= {period.begin:.0f})"
    return (
        f"(increase({series}[{ago}]) and resets({series}[{ago}]) > 0)"
        f" or (last_over_time({series}[{ago}]) - {series} offset {ago})"
        f" or (last_over_time({series}[{ago}]) and on (job, instance) {fresh})"
        f" or (last_over_time({series}[{ago}]) - min_over_time({series}[{ago}]))"
    )


def came_to(labels: str, metric: str, where: str, period: Span) -> str:
    """Return the sums of these increases by labels."""
    return f"sum by ({labels}) ({came(metric, where, period)})"


def recovered(where: str, period: Span) -> str:
    """Return the increase of the operator's counts of recoveries, from any replica; they outlive monitors."""
    series, ago, by = f"understudy_workload_recoveries_total{where}", length(period), "by (namespace, workload)"
    last = f"max {by} (last_over_time({series}[{ago}]))"
    return (
        f"sum(clamp_min({last} - max {by} ({series} offset {ago})"
        f" or {last} and on () (max(understudy_leader offset {ago}))"
        f" or {last} - min {by} (min_over_time({series}[{ago}])), 0))"
    )


def over(function: str, way: str, labels: str, series: str, period: Span) -> str:
    """Return an aggregate (``way``) by labels of a gauge over the period (``function``)."""
    return f"{way} by ({labels}) ({function}_over_time({series}[{length(period)}]))"


def length(period: Span) -> str:
    """Format the length of a period for PromQL."""
    return f"{math.ceil(period.length)}s"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
