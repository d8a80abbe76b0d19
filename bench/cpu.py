"""Mean CPU of each pod over a run, from the kubelets' own counters.

The paper's second metric, sigma(CPU): the mean CPU of each container over the whole run, summed. It is taken from the
kubelet's resource metrics (``/metrics/resource``, KEP-727), which have cAdvisor's counters as the paper's do.
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
    """CPU seconds that a container has used, and when that was read (Unix seconds, the node's clock)."""

    seconds: float
    at: float


def counters(text: str) -> dict[Container, Counter]:
    """The containers' CPU counters of one node's resource metrics."""
    found = {}
    for line in text.splitlines():
        if match := _LINE.match(line):
            container = Container(match["namespace"], match["pod"], match["container"])
            found[container] = Counter(float(match["value"]), int(match["stamp"]) / 1000)
    return found


@dataclass
class Usage:
    """CPU used over a run, container by container."""

    used: dict[Container, float] = field(default_factory=lambda: defaultdict(float))
    """CPU seconds since the first reading; what a container used before the run doesn't count, one that began in it does."""
    _last: dict[Container, Counter] = field(default_factory=dict)
    _begun: float | None = None
    _ended: float = 0.0

    def read(self, text: str, *, first: bool = False) -> None:
        """Take in one node's metrics; ``first`` for the readings at the start of the run."""
        for container, counter in counters(text).items():
            former = self._last.get(container)
            if former is None:
                self.used[container] += 0.0 if first else counter.seconds
            elif counter.seconds >= former.seconds:
                self.used[container] += counter.seconds - former.seconds
            else:
                self.used[container] += counter.seconds  # restarted: the counter began again
            self._last[container] = counter
            self._begun = counter.at if self._begun is None else min(self._begun, counter.at)
            self._ended = max(self._ended, counter.at)

    @property
    def seconds(self) -> float:
        """How long the run was, between the first and the last reading."""
        return self._ended - self._begun if self._begun is not None else 0.0

    def milli(self, select: Callable[[Container], str | None]) -> dict[str, float]:
        """Mean milli-CPU over the run by group; ``select`` names a container's group, None leaves it out."""
        found: dict[str, float] = defaultdict(float)
        if self.seconds <= 0:
            return found
        for container, used in self.used.items():
            if (group := select(container)) is not None:
                found[group] += 1000 * used / self.seconds
        return dict(found)


class Sampler:
    """Reads the counters of all nodes now and then, in a thread, between ``with`` and its end.

    ``fetch`` gives a node's metrics and may raise OSError or RuntimeError while a node is away, which leaves it out.
    """

    def __init__(self, nodes: Iterable[str], fetch: Callable[[str], str], *, period: float = 5.0) -> None:
        """``period`` in seconds: containers that come and go between two readings are missed."""
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
