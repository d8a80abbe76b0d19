"""What a Prometheus is asked for, over a whole period: expressions in PromQL; pure.

``increase`` alone would be wrong here. It can't see the first recovery by each strategy after each start of a monitor, with which
that series begins, and most robots have few; and it extrapolates to the ends of the period, so that counts aren't whole numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection

from understudy.cli.report.recovery_records import Span

ALIVE = "understudy_tree_evaluations_total"
"""What every monitor has told from its start on."""


def selector(namespace: str | None = None, workloads: Collection[str] = (), **labels: str) -> str:
    """Which series are meant; of all namespaces and workloads where none is named."""
    told = [f'{label}="{_escaped(value)}"' for label, value in labels.items()]
    if namespace is not None:
        told.insert(0, f'namespace="{_escaped(namespace)}"')
    if workloads:
        told.append(f'workload=~"{_escaped("|".join(re.escape(name) for name in sorted(workloads)))}"')
    return f"{{{','.join(told)}}}"


def came(metric: str, where: str, period: Span) -> str:
    """What came to each series of monitors' counters in the period.

    In this order: one that began anew in its pod is left to ``increase``; of one that was there when the period began the difference
    is taken; one that wasn't, though its monitor was already told of or wasn't there yet either, counts from 0; and of one whose monitor
    is older than what is known of it, only what came since.
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
    """The sums of that by some labels."""
    return f"sum by ({labels}) ({came(metric, where, period)})"


def recovered(where: str, period: Span) -> str:
    """By how many recoveries the workloads' own counts grew, which outlive monitors; whichever replica of the operator told of them."""
    series, ago, by = f"understudy_workload_recoveries_total{where}", length(period), "by (namespace, workload)"
    last = f"max {by} (last_over_time({series}[{ago}]))"
    return (
        f"sum(clamp_min({last} - max {by} ({series} offset {ago})"
        f" or {last} and on () (max(understudy_leader offset {ago}))"
        f" or {last} - min {by} (min_over_time({series}[{ago}])), 0))"
    )


def over(function: str, way: str, labels: str, series: str, period: Span) -> str:
    """A gauge over the period, such as the greatest (``way``) of the greatest over time (``function``) by some labels."""
    return f"{way} by ({labels}) ({function}_over_time({series}[{length(period)}]))"


def length(period: Span) -> str:
    """How long it is, as PromQL writes it."""
    return f"{math.ceil(period.length)}s"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
