"""Compares the cost of several monitors in the same run: CPU time over all threads by the kernel's account, and
resident memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

from bench.results import Report
from bench.roles import Role

UNITS = {"CPU": "milli-CPU", "memory": "MB", "received": "messages/s"}

Found = Mapping[tuple[str, str], Sequence[float]]
"""The result of each round, by quantity and watcher."""


def measured(watched: Callable[[], AbstractContextManager[Sequence[Role]]], rounds: int, length: float) -> Found:
    """Measure watchers for ``length`` seconds per round. They are started again for each round."""
    found: dict[tuple[str, str], list[float]] = {}
    for number in range(rounds):
        with watched() as watchers:
            time.sleep(2.0)
            before = [(time.monotonic(), watcher.cpu(), _received(watcher)) for watcher in watchers]
            time.sleep(length)
            for watcher, (begun, cpu, received) in zip(watchers, before, strict=True):
                passed = time.monotonic() - begun
                now = {
                    "CPU": 1000 * (watcher.cpu() - cpu) / passed,
                    "memory": watcher.rss(),
                    "received": (_received(watcher) - received) / passed,
                }
                for name, value in now.items():
                    found.setdefault((name, watcher.name), []).append(value)
                shown = f"{now['CPU']:.1f} milli-CPU, {now['memory']:.1f} MB, {now['received']:.0f} messages/s"
                print(f"round {number + 1}/{rounds}: {watcher.name} {shown}", flush=True)
    return found


def told(report: Report, found: Found, *, cpu: float, memory: float, baseline: str) -> None:
    """Add the results to a report, with the most milli-CPU and MB that our monitor may use, with and without kept
    state."""
    bounds = {"CPU": {"max": cpu}, "memory": {"max": memory}, "received": {}}
    for name, must in bounds.items():
        report.figure(name, found[name, "ours"], unit=UNITS[name], must=must)
        report.figure(f"{name}, state kept", found[name, "keeping"], unit=UNITS[name], must=must)
        report.baseline(name, found[name, "callbacks"], unit=UNITS[name], of=baseline)


def more(report: Report, found: Found, watcher: str, called: str, *, cpu: float, memory: float) -> None:
    """Add the CPU and memory of one more watcher to a report."""
    for name, most in (("CPU", cpu), ("memory", memory)):
        report.figure(f"{name}, {called}", found[name, watcher], unit=UNITS[name], must={"max": most})


def _received(watcher: Role) -> int:
    return int(watcher.ask("received")["received"])
