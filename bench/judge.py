"""Watches a robot as the monitor does, in a process with everything that the monitor imports, without an API server.

It uses the monitor's health observer (understudy.monitor.observe.robot.health_observer) with the same wake-ups
(understudy.monitor.observe.wakeups), kept state (understudy.monitor.act.instances.state_manager) and the black box
(understudy.monitor.report.black_box).
"""

from __future__ import annotations

import asyncio
import gc
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from bench.counting import least_count, most_count, worst_gap
from bench.roles import answer, end_with_parent, tell

EVIDENCE = 4.0
"""Seconds of a topic's times of receipt that are reported with a failure."""


def judge(
    monitoring: Mapping[str, Any],
    topics: Sequence[str],
    *,
    outputs: Sequence[Mapping[str, str]] = (),
    kept: Sequence[str] = (),
    black_box: Mapping[str, Any] | None = None,
    ip: str = "192.0.2.10",
    leaves: Mapping[str, str] | None = None,
) -> None:
    """Judge until killed, report failures, and answer ``received`` and ``seen``; ``record`` turns the black box on and
    off.

    Args:
        monitoring: as of a FailurePolicy.
        topics: the received topics about which it answers.
        outputs: the workload's gated outputs.
        kept: topics whose state is kept.
        black_box: as of a FailurePolicy.
        ip: that of the active instance; empty if all processes count as its own.
        leaves: by path of a leaf, the topic whose times of receipt are reported with its failure.
    """
    _Judge(monitoring, topics, outputs, kept, black_box, ip, leaves or {}).run()


class _Judge:
    def __init__(
        self,
        monitoring: Mapping[str, Any],
        topics: Sequence[str],
        outputs: Sequence[Mapping[str, str]],
        kept: Sequence[str],
        black_box: Mapping[str, Any] | None,
        ip: str,
        leaves: Mapping[str, str],
    ) -> None:
        import understudy.monitor.process  # noqa: F401  (what the monitor's process has in memory)
        from understudy.api.kinds.failure_policy import FailurePolicySpec
        from understudy.api.kinds.robot_workload import RobotWorkloadSpec
        from understudy.failover.interfaces import Instance
        from understudy.monitor.act.instances.state_manager import StateManager
        from understudy.monitor.notices import Notices
        from understudy.monitor.observe.robot.health_observer import HealthObserver
        from understudy.monitor.report.black_box import BlackBox
        from understudy.monitor.report.recording_archive import RecordingArchive
        from understudy.process import cpu_scheduling
        from understudy.state.state_store import StateStore
        from understudy.trees.languages.notations import load_monitoring

        end_with_parent()
        cpu_scheduling.ask_for_short_slices()  # before any thread starts, as in the monitor
        self.policy = FailurePolicySpec.model_validate(
            {
                "monitoring": monitoring,
                "strategies": [{"type": "Restart"}],
                "state": {"keep": [{"topic": topic} for topic in kept]},
                "blackBox": black_box,
            }
        )
        self.spec = RobotWorkloadSpec.model_validate(
            {"template": {}, "outputs": list(outputs), "failurePolicyRef": {"name": "bench"}}
        )
        self.instances = [Instance("active", "1", ip=ip), Instance("standby", "2", ip="192.0.2.11")]
        self.sight = HealthObserver()
        self._folder = tempfile.TemporaryDirectory()
        self.state_manager = StateManager(self.sight.graph, StateStore(Path(self._folder.name)), _Nobody(), Notices())
        self._view: Any = SimpleNamespace(policy=self.policy, workload="bench", namespace="bench")
        self.box = BlackBox(self._view, self.sight, Notices(), RecordingArchive(Path(self._folder.name) / "recordings"))
        self.topics, self.leaves = topics, leaves
        self.verdicts = self.failed = self.doubted = 0
        self.late = self.waited = 0.0
        self._prompt = {topic.name: 0.0 for topic in load_monitoring(self.policy.monitoring).topics if topic.prompt}
        self.asked = time.time()

    def run(self) -> None:
        asyncio.run(self._watch())

    async def _watch(self) -> None:
        """Watch as understudy.monitor.loop does, with only those parts that detect failures."""
        from understudy.api.base import seconds
        from understudy.monitor.loop import SLOW
        from understudy.monitor.observe.wakeups import TICK, WAKE_LATE, EvaluationSchedule, Wakeups
        from understudy.trees.core.debounce import Debounce

        answers = {"received": self._received, "seen": self._seen, "record": self._record}
        asyncio.get_running_loop().add_reader(sys.stdin, lambda: answer(sys.stdin.readline(), answers))
        self._recording = asyncio.create_task(self.box.run())
        schedule, debounce = EvaluationSchedule(Wakeups(), self.sight.coming), Debounce()
        since, slow, state = time.time(), 0.0, "Starting"
        gc.collect()
        gc.freeze()
        tell("ready")
        while True:
            now = schedule.begin()
            self.late = max(self.late, schedule.late)
            self.sight.follow(self.policy, self.spec)
            self.sight.drain(self.instances, "active")
            self.state_manager.take(self.policy.state, self.sight.addresses, "active")
            self._note_waiting(now)
            verdict = self.sight.verdict(now=now, since=since)
            self.state_manager.judge(verdict.state, now)
            detected, due = time.time(), None
            self.verdicts += 1
            if verdict.state != "Failed":
                debounce.clear()
                due = self.sight.deadline(now=now, since=since)
                if verdict.state != state:
                    state = verdict.state
                    tell(state.lower(), at=detected, reason=verdict.reason)
            elif detected < schedule.trusted_from:
                self.doubted += 1
                due = schedule.trusted_from
            elif detected < (counts := debounce.failed(detected, seconds(self.policy.monitoring.debounce))):
                due = counts
            elif state != "Failed":
                state = "Failed"
                self.failed += 1
                self._tell_failure(verdict, detected)
            if now >= slow:
                slow = now + SLOW
                self.state_manager.housekeeping(self.instances[0], [])
            next_evaluation = now + TICK
            await schedule.until(next_evaluation if due is None else min(next_evaluation, due + WAKE_LATE))

    def _note_waiting(self, now: float) -> None:
        """Note how long messages have waited that must be evaluated on arrival."""
        for topic, seen in self._prompt.items():
            record = self.sight.observations.topic(topic)
            if record is None or record.last is None or record.last == seen:
                continue
            first = min(takewhile(lambda time, seen=seen: time > seen, reversed(record.arrivals)), default=now)
            self.waited = max(self.waited, now - first) if seen else self.waited
            self._prompt[topic] = record.last

    def _tell_failure(self, verdict: Any, detected: float) -> None:
        record = self.sight.observations.topic(self.leaves.get(verdict.leaf, ""))
        arrivals = [time for time in record.arrivals if time > detected - EVIDENCE] if record is not None else []
        tell(
            "failed",
            detected=detected,
            leaf=verdict.leaf,
            reason=verdict.reason,
            onset=verdict.onset,
            arrivals=arrivals,
        )

    def _received(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        records = [self.sight.observations.topic(topic) for topic in self.topics]
        return {"received": sum(record.count for record in records if record is not None)}

    def _record(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """``black_box`` is as of a FailurePolicy."""
        from understudy.api.kinds.recording_spec import BlackBox

        settings = BlackBox.model_validate(asked["black_box"]) if asked["black_box"] is not None else None
        self._view.policy = self.policy.model_copy(update={"black_box": settings})
        return {}

    def _seen(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return the results since the last such question: the worst gap of each topic, and the fewest and most
        messages in a window.

        ``windows`` has the length of each topic's window in seconds.
        """
        since, self.asked = self.asked, time.time()
        found: dict[str, Any] = {"gaps": {}, "least": {}, "most": {}}
        for topic in self.topics:
            if (record := self.sight.observations.topic(topic)) is None:
                continue
            times = list(record.arrivals)
            found["gaps"][topic] = worst_gap(times, since)
            if window := asked["windows"].get(topic):
                found["least"][topic] = least_count(times, window, since)
                found["most"][topic] = most_count(times, window, since)
        late, waited, self.late, self.waited = self.late, self.waited, 0.0, 0.0
        counts = {"verdicts": self.verdicts, "failed": self.failed, "doubted": self.doubted}
        return {**found, **counts, "late": late, "waited": waited}


class _Nobody:
    """Stands for a receiver that does nothing."""
