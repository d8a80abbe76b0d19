"""Mean CPU of each pod over a run, from the kubelets' own counters.

This is the paper's second metric, sigma(CPU): the mean CPU of each container over the whole run, summed. It comes from
the kubelet's resource metrics (``/metrics/resource``, KEP-727), which contain cAdvisor's counters, as the paper's do.
"""

from __future__ import annotations

import re
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

_LINE = re.compile(
    r'^container_cpu_usage_seconds_total\{container="(?P<container>[^"]*)",namespace="(?P<namespace>[^"]*)",'
    r'pod="(?P<pod>[^"]*)"\} (?P<value>\S+) (?P<stamp>\d+)$'
)


@dataclass(frozen=True)
class Container:
    """One container of one pod."""

    namespace: str
    pod: str
    name: str


@dataclass(frozen=True)
class Counter:
    """The CPU seconds that a container has used, and when they were read (Unix seconds, the node's clock)."""

    seconds: float
    at: float


def counters(text: str) -> dict[Container, Counter]:
    """Return the containers' CPU counters in one node's resource metrics."""
    found = {}
    for line in text.splitlines():
        if match := _LINE.match(line):
            container = Container(match["namespace"], match["pod"], match["container"])
            found[container] = Counter(float(match["value"]), int(match["stamp"]) / 1000)
    return found


@dataclass
class Usage:
    """The CPU that each container used over a run."""

    used: dict[Container, float] = field(default_factory=lambda: defaultdict(float))
    """CPU seconds since the first reading. Use before the run does not count. All use of a container that started in
    the run does."""
    _last: dict[Container, Counter] = field(default_factory=dict)
    _begun: float | None = None
    _ended: float = 0.0

    def read(self, text: str, *, first: bool = False) -> None:
        """Add one node's metrics; ``first`` for the readings at the start of the run."""
        for container, counter in counters(text).items():
            former = self._last.get(container)
            if former is None:
                self.used[container] += 0.0 if first else counter.seconds
            elif counter.seconds >= former.seconds:
                self.used[container] += counter.seconds - former.seconds
            else:
                self.used[container] += counter.seconds  # the container restarted, and its counter began at 0
            self._last[container] = counter
            self._begun = counter.at if self._begun is None else min(self._begun, counter.at)
            self._ended = max(self._ended, counter.at)

    @property
    def seconds(self) -> float:
        """The length of the run, from the first to the last reading."""
        return self._ended - self._begun if self._begun is not None else 0.0

    def milli(self, select: Callable[[Container], str | None]) -> dict[str, float]:
        """Return the mean milli-CPU over the run by group. ``select`` returns a container's group, None to leave it
        out."""
        found: dict[str, float] = defaultdict(float)
        if self.seconds <= 0:
            return found
        for container, used in self.used.items():
            if (group := select(container)) is not None:
                found[group] += 1000 * used / self.seconds
        return dict(found)


class Sampler:
    """Reads the counters of all nodes at intervals, in a thread, for the duration of the context.

    ``fetch`` returns a node's metrics. It may raise OSError or RuntimeError while a node is away; the node is then left
    out.
    """

    def __init__(self, nodes: Iterable[str], fetch: Callable[[str], str], *, period: float = 5.0) -> None:
        """``period`` is in seconds. Containers that exist only between two readings are missed."""
        self.usage = Usage()
        self._nodes, self._fetch, self._period = list(nodes), fetch, period
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Sampler:
        self._read(first=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._read()

    def _run(self) -> None:
        while not self._ended.wait(self._period):
            self._read()

    def _read(self, *, first: bool = False) -> None:
        for node in self._nodes:
            try:
                text = self._fetch(node)
            except (OSError, RuntimeError):
                continue
            self.usage.read(text, first=first)
