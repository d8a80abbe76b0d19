"""Builds the reference page of metrics from the metrics themselves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from types import ModuleType

from prometheus_client.core import Metric
from prometheus_client.metrics import MetricWrapperBase

from understudy.controller.reconcile import operator_metrics as operator
from understudy.controller.reconcile.object_store import Store
from understudy.controller.runtime.fleet_metrics import FleetMetrics
from understudy.monitor.report import monitor_metrics as monitor

_INTRODUCTION = """\
# Metrics reference

<!-- Written by scripts/generate from the metrics in operator/understudy: change those. -->

All that operator and monitors serve at port 9108 (`/metrics`), besides what Prometheus' client library tells of each process, such
as `process_cpu_seconds_total`. Agents and task proxies serve none. How they are scraped, which alerts there are and what these mean
for a robot is in [metrics, alerts and dashboards](../metrics.md). Of a histogram there are the series `_bucket`, `_sum` and
`_count`."""


def page() -> str:
    """Return a page with all metrics of Understudy as Markdown, by the component that exposes them."""
    lines = [_INTRODUCTION]
    for who, described in (("operator", _operator()), ("monitor", _monitor())):
        lines += ["", f"## Of the {who}", "", "| metric | type | labels | what it says |", "| --- | --- | --- | --- |"]
        for metric, labels in sorted(described, key=lambda pair: pair[0].name):
            name = f"{metric.name}_total" if metric.type == "counter" else metric.name
            told = ", ".join(f"`{label}`" for label in labels)
            lines.append(f"| `{name}` | {metric.type} | {told} | {metric.documentation} |")
    return "\n".join(lines) + "\n"


def exposed() -> set[str]:
    """Return the names of all series of Understudy, as Prometheus stores them."""
    endings = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}
    return {m.name + end for m, _ in (*_operator(), *_monitor()) for end in endings.get(m.type, ("",))}


def _operator() -> list[tuple[Metric, tuple[str, ...]]]:
    return [*_of_module(operator), *_of(FleetMetrics(Store(), lambda: False).describe())]


def _monitor() -> list[tuple[Metric, tuple[str, ...]]]:
    return [*_of_module(monitor), *_of(monitor.ObservationMetrics(dict, lambda: (0, 0)).describe())]


def _of_module(module: ModuleType) -> Iterator[tuple[Metric, tuple[str, ...]]]:
    for found in vars(module).values():
        if isinstance(found, MetricWrapperBase):
            for metric in found.describe():
                yield metric, tuple(found._labelnames)


def _of(families: Iterable[Metric]) -> Iterator[tuple[Metric, tuple[str, ...]]]:
    for family in families:
        yield family, tuple(getattr(family, "_labelnames", ()))
