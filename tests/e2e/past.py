"""A past of some monitors and their operator as a Prometheus would have scraped it, to be made into its blocks by promtool."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

EVERY = 60
"""Seconds between two scrapes."""

BOUNDS = (0.001, 0.01, 0.1, 1.0, 10.0, float("inf"))


class Source(Protocol):
    """What is scraped."""

    def told(self, now: float) -> Iterator[str]:
        """What it tells at a moment."""
        ...


class Recovery(NamedTuple):
    """One that a monitor counted."""

    at: float
    strategy: str = "Fallback/Executing"
    result: str = "Recovered"
    cluster: float = 0.006


@dataclass(frozen=True)
class Monitor:
    """One pod of a robot's monitor."""

    workload: str
    instance: str
    begun: float
    """When its process began."""
    ended: float
    recoveries: Sequence[Recovery]
    restarted: float | None = None
    """When its container restarted in the same pod."""
    scraped: float = 0.0
    """From when on it was scraped."""
    namespace: str = "fleet"

    def told(self, now: float) -> Iterator[str]:
        """What it tells at a moment."""
        if not max(self.begun, self.scraped) <= now < self.ended:
            return
        begun = self.restarted if self.restarted is not None and self.restarted <= now else self.begun
        mine = f'job="monitors",instance="{self.instance}",namespace="{self.namespace}",workload="{self.workload}"'
        yield f"process_start_time_seconds{{{mine}}} {begun}"
        yield f"understudy_tree_evaluations_total{{{mine}}} {20 * (now - begun)}"
        counted = sorted(r for r in self.recoveries if begun <= r.at <= now)
        kinds = sorted({(r.strategy, r.result) for r in counted})
        for strategy, result in kinds:
            found = [r for r in counted if (r.strategy, r.result) == (strategy, result)]
            labels = f'{mine},strategy="{strategy}"'
            yield f'understudy_recoveries_total{{{labels},result="{result}"}} {len(found)}'
            if result == "Recovered":
                for part, times in (("detection", [0.5] * len(found)), ("cluster", [r.cluster for r in found])):
                    yield from histogram("understudy_recovery_part_seconds", f'{labels},part="{part}"', times)
                yield from histogram("understudy_recovery_seconds", labels, [0.5 + r.cluster for r in found])


def histogram(name: str, labels: str, times: Sequence[float], bounds: Sequence[float] = BOUNDS) -> Iterator[str]:
    """All series of one, of these times."""
    for bound in bounds:
        yield f'{name}_bucket{{{labels},le="{"+Inf" if bound == bounds[-1] else bound}"}} {sum(t <= bound for t in times)}'
    yield f"{name}_sum{{{labels}}} {sum(times)}"
    yield f"{name}_count{{{labels}}} {len(times)}"


@dataclass(frozen=True)
class Operator:
    """Two replicas, of which the second leads from some moment on. It counts what monitors wrote into the status, and has one pool."""

    handed_over: float
    monitors: Sequence[Monitor]
    ready: Callable[[float], int]

    def told(self, now: float) -> Iterator[str]:
        """What they tell at a moment."""
        mine = f'job="operator",instance="{"b" if now >= self.handed_over else "a"}"'
        for (namespace, workload), found in itertools.groupby(self.monitors, key=lambda m: (m.namespace, m.workload)):
            count = sum(r.at <= now for monitor in found for r in monitor.recoveries)
            yield f'understudy_workload_recoveries_total{{{mine},namespace="{namespace}",workload="{workload}"}} {count}'
        pool = f'{mine},namespace="fleet",pool="spare"'
        ready = self.ready(now)
        for state, number in (("ready", ready), ("unready", 4 - ready), ("claimed", 1)):
            yield f'understudy_pool_pods{{{pool},state="{state}"}} {number}'
        yield f"understudy_pool_desired_pods{{{pool}}} 4"
        yield f"understudy_pool_waiting_workloads{{{pool}}} {int(not ready)}"


def every(seconds: float, begin: float, end: float) -> Iterator[float]:
    """Moments from one to another."""
    yield from (begin + number * seconds for number in range(int((end - begin) / seconds) + 1))


def openmetrics(moments: Iterable[float], sources: Sequence[Source]) -> str:
    """All that was scraped at these moments."""
    lines = [f"{line} {now}" for now in moments for source in sources for line in source.told(now)]
    return "\n".join([*lines, "# EOF", ""])
