"""What a monitor knows of a robot with a mux: what instances send, which it receives itself, and what the mux reports."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

from tests.unit.interleavings.actors import Monitor
from tests.unit.interleavings.mux_robots import MuxRobots
from tests.unit.interleavings.mux_topics import MonitorExchange
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.senses import GAP, TOPIC, HealthObserver
from understudy.api.protocol.mux_messages import Report
from understudy.failover.protocol import SILENCE_MARGIN
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import SILENT, MuxReports
from understudy.monitor.act.gate.mux_orders import MuxOrders, ready_names
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.observe.robot import health_observer as observer
from understudy.monitor.observe.robot.health_observer import ForwardedOutputs
from understudy.monitor.observe.robot.known_senders import OutputSender

HISTORY = 3.0
"""Seconds for which arrivals are known."""

_MOMENT = 1e-6
"""Seconds within which two times are the same."""


@dataclass
class Stream:
    """Samples of an instance that a monitor receives, in Unix seconds."""

    phase: float
    period: float
    since: float = math.inf
    """Since when they flow; infinite while they do not."""
    before: float | None = None
    """The last one before those that flow now."""

    def last(self, now: float) -> float | None:
        """When the last one arrived."""
        last = self.phase + math.floor((now - self.phase + _MOMENT) / self.period) * self.period
        return last if last >= self.since - _MOMENT else self.before

    def next(self, since: float) -> float:
        """When one arrives at or after a time, while they flow."""
        return self.phase + math.ceil((since - self.phase - _MOMENT) / self.period) * self.period

    def first(self, since: float, now: float) -> float | None:
        """When one first arrived at or after a time; of earlier streams only the last is known."""
        if self.before is not None and self.before >= since:
            return self.before
        first = self.next(max(since, self.since)) if self.since < math.inf else math.inf
        return first if first <= now + _MOMENT else None

    def arrivals(self, now: float) -> list[float]:
        """When they arrived of late."""
        if self.since == math.inf:
            return []
        first = self.next(max(self.since, now - HISTORY))
        return [first + self.period * number for number in range(int((now - first) / self.period + _MOMENT) + 1)]


class MuxSight(HealthObserver):
    """What a monitor receives, whomever the mux forwards."""

    expected: Sequence[str] = (TOPIC,)

    def __init__(
        self, process: Process, robots: MuxRobots, workload: str, looked: Callable[[], None], reports: MuxReports
    ) -> None:
        super().__init__(process, robots, workload, looked)
        self._process, self._links, self._reports = process, robots, reports
        self._streams: dict[str, Stream] = {}
        robots.listen(workload, self)

    unreached = observer.HealthObserver.unreached
    drove_on_board = observer.HealthObserver.drove_on_board

    @property
    def _forwarding(self) -> MuxReports:
        return self._reports

    @property
    def listens(self) -> bool:
        """Whether its monitor lives."""
        return self._process.alive

    def flow(self, found: Running) -> None:
        """What an instance sends to it may be something else now."""
        robots, now = self._links, self._robots.now
        is_reached = found.uid not in robots.unheard and self._process not in robots.network.apart
        flows = found.sends and is_reached and found.ip not in robots.network.unreachable
        stream = self._streams.setdefault(found.uid, Stream(found.phase, found.period))
        if not flows or stream.period != found.period:
            stream.before, stream.since = stream.last(now), math.inf
            stream.period = found.period
        if flows and stream.since == math.inf:
            stream.since = now

    def _stream(self, found: Running | None) -> Stream | None:
        return self._streams.get(found.uid) if found is not None else None

    def _last(self, found: Running | None) -> float | None:
        stream = self._stream(found)
        last = stream.last(self._robots.now) if stream is not None else None
        return self._stamp(last) if last is not None else None

    def first(self, found: Running | None, since: float) -> float | None:
        stream, now = self._stream(found), self._robots.now
        first = stream.first(now - (self.now - since), now) if stream is not None else None
        return self._stamp(first) if first is not None else None

    def deadline(self, *, now: float, since: float) -> float | None:
        last, stream = self._received_since(since), self._stream(self._named(self._active))
        if last is None or stream is None:
            return super().deadline(now=now, since=since)
        return None if stream.since < math.inf and stream.period < GAP else last + GAP

    def arrivals(self, topic: str, pod: str) -> list[float]:
        """When samples of an instance arrived of late."""
        stream = self._stream(self._named(pod))
        return [self._stamp(at) for at in stream.arrivals(self._robots.now)] if stream is not None else []

    def ambiguous(self, pod: str) -> bool:
        """Never: writers have partitions."""
        return False

    def output_senders(self) -> Sequence[OutputSender]:
        return ()

    def first_from(self, topic: str, pod: str, *, since: float) -> float | None:
        """When a sample of an instance first arrived at or after a time."""
        return self.first(self._named(pod), since)

    def outputs(self, fleet: Any, gate: Any) -> Any:
        watching = SimpleNamespace(sources=SimpleNamespace(ambiguous=()), first_from=self.first_from)
        return ForwardedOutputs(cast(Any, self), cast(Any, watching), fleet, gate, self._reports)


class NotedReports(MuxReports):
    """The real ones, and when they arrived."""

    def __init__(self, clock: Callable[[], float]) -> None:
        super().__init__()
        self._clock = clock
        self.times: list[float] = []

    def add(self, report: Report) -> None:
        super().add(report)
        if self.latest is not None and self.latest.report is report:
            self.times.append(self._clock())

    def were_silent(self, at: float) -> bool:
        """Whether the monitor took its mux for gone at a time (Unix seconds)."""
        return not any(at - SILENT <= one <= at for one in self.times)


class MuxMonitor(Monitor):
    """One that orders a mux."""

    gate_kind = registry.KINDS["Mux"]

    def __init__(
        self, process: Process, network: Any, robots: MuxRobots, workload: str, *rest: Any, **more: Any
    ) -> None:
        super().__init__(process, network, robots, workload, *rest, **more)
        self.reports: NotedReports | None = None
        self.absent_at = robots.now
        """When (Unix seconds) its process last stood still, had just begun, lost the API server, or was busy with a recovery."""

    @property
    def mux_robots(self) -> MuxRobots:
        """The robots."""
        return cast(MuxRobots, self._robots)

    def _make_probes(self) -> MuxReports:
        self.reports = NotedReports(lambda: self._robots.now)
        return self.reports

    def _make_observer(self) -> HealthObserver:
        assert self.reports is not None
        return MuxSight(self.process, self.mux_robots, self.workload, self._look_at_gate, self.reports)

    def _beside(self, loop: MonitorLoop, parts: Parts, group: asyncio.TaskGroup) -> None:
        assert self.reports is not None
        cluster, agents = parts.cluster, parts.senses.agents
        orders = MuxOrders(
            self._network.client(self.process),
            cluster.view,
            MonitorExchange(self.mux_robots.muxes[self.workload].topics, self.process),
            self.reports,
            lambda: ready_names(cluster.pods, agents, cluster.gate.state.active_uid),
            lambda: [TOPIC],
            loop.act.safety,
        )
        group.create_task(orders.run())

    def note_hindrance(self) -> None:
        super().note_hindrance()
        mux, network = self.mux_robots.muxes[self.workload], self._network
        is_alone = self.process in network.cut_off or self.process in network.denied
        if self.process.stalled or self.notices is None or is_alone or self.current.progress is not None:
            self.absent_at = self._robots.now
        # Without reports it judges by what instances send.
        is_blind = self.reports is None or self.reports.were_silent(self._robots.now)
        if (
            is_blind
            or mux.is_hindered
            or self.process in mux.topics.parted
            or self.process in network.apart
            or mux.topics.loss
        ):
            self.hindered_at = self.cut_off_at = self._robots.now
        if self.mux_robots.cut or self.mux_robots.unheard:
            self.hindered_at = self.cut_off_at = self._robots.now

    def knew(self, at: float) -> frozenset[str]:
        """None while no mux reported: then a monitor has nothing but what it receives of instances, and cannot know who is forwarded.

        It judges by that a moment before a recovery is verified.
        """
        reports = self.reports
        is_blind = reports is None or reports.were_silent(at) or reports.were_silent(at - SILENCE_MARGIN)
        return frozenset() if is_blind else super().knew(at)

    @property
    def gate_record(self) -> GateRecord | None:
        """The record of its gate as it knows it."""
        return self._view.gate_record if self._view is not None else None

    def condition(self, kind: str) -> tuple[str, str]:
        """Status and reason of a condition that it reports; empty if it does not."""
        conditions = self.notices.status.to_wire()["conditions"] if self.notices is not None else []
        return next(((c["status"], c["reason"]) for c in conditions if c["type"] == kind), ("", ""))
