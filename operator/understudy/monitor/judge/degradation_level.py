"""Judges whether the workload is Degraded: its health tree succeeds, but the tree of ``spec.degraded`` fails.

Degradation is judged in the same evaluations as health and never delays the verdict on health: the monitor acts on a
failure equally fast at every level. Without ``spec.degraded``, nothing is evaluated.
"""

from __future__ import annotations

import logging
import time
from datetime import datetime

from understudy.api.base import seconds
from understudy.api.kinds.degraded_spec import Degraded, Reschedule
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.degradation import Level
from understudy.failover.interfaces import Instance
from understudy.monitor.notices import BecameDegraded, Notices
from understudy.monitor.observe.robot.degraded_tree import BusyReason
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.trees.core.health_tree import Verdict

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.2
"""Seconds between two checks: degradation matters within seconds, not within milliseconds."""

AGAIN = 30.0
"""Minimum seconds between two updates of the message if only its figures have changed."""

CONDITION, TASKS = "Degraded", "TasksProxied"

_WAITS = " No switchover yet: "


class DegradationLevel:
    """The level of the active instance, and whether a degraded instance is due to be handed over."""

    def __init__(self, observer: HealthObserver, notices: Notices) -> None:
        self._observer, self._notices = observer, notices
        self._level = Level()
        self._uid = ""
        self._next = 0.0
        self._reported_at = 0.0
        self._reported = ("", "")
        self._words = ""
        self._idle_since: float | None = None
        self._waits: BusyReason | None = None
        self._lacking: BusyReason | None = None
        self._handed_over: float | None = None
        self._due = False
        self._in_force = (
            True  # so that the condition of an earlier monitor is withdrawn if the policy has no spec.degraded
        )

    @property
    def degraded(self) -> bool:
        """Whether the active instance was degraded at the last evaluation."""
        return self._level.since is not None

    @property
    def due(self) -> str | None:
        """The reason to hand over the instance now; None if no hand-over is due."""
        return (
            f"degraded: {self._words}; switched over while the robot was idle" if self._due and self.degraded else None
        )

    def handed_over(self) -> None:
        """Note that a planned hand-over has begun."""
        self._handed_over, self._due, self._lacking = time.monotonic(), False, None

    def wait(self, kind: str, words: str) -> None:
        """Note why a due hand-over cannot begin. It is due again at the next evaluation."""
        self._due, self._lacking = False, BusyReason(kind, words)

    def evaluate(
        self, policy: FailurePolicySpec, verdict: Verdict, active: Instance, *, now: float, since: float
    ) -> bool:
        """Return whether the instance is degraded, given the verdict of its health tree. Times are Unix seconds."""
        if policy.degraded is None:
            if self._in_force:
                self._end()
            return False
        self._in_force = True
        clock = time.monotonic()
        if active.uid != self._uid:
            self._begin(active, clock)
        if clock >= self._next:
            self._next = clock + CHECK_PERIOD
            self._judge(policy.degraded, verdict, clock, now=now, since=since)
        return self.degraded

    def _end(self) -> None:
        self._in_force, self._uid, self._level = False, "", Level()
        self._notices.withdraw(CONDITION)

    def _begin(self, active: Instance, clock: float) -> None:
        """Start to judge another instance. Its level is unknown, unless an earlier monitor judged the same instance."""
        published = self._notices.status.find(CONDITION)
        self._level, self._idle_since, self._due, self._lacking = Level(), None, False, None
        if published is not None and published.status == "True":
            if not self._uid and self._notices.status.adopted == active.name:
                length = time.time() - datetime.fromisoformat(published.last_transition_time).timestamp()
                self._level, self._reported_at = Level(clock - max(0.0, length)), clock
                self._words = published.message.partition(_WAITS)[0].removesuffix(".")
            else:
                self._notices.condition(CONDITION, "Unknown", "Starting", f"{active.name} has just taken control.")
        self._uid, self._next = active.uid, clock

    def _judge(self, degraded: Degraded, verdict: Verdict, clock: float, *, now: float, since: float) -> None:
        # The tree of spec.degraded counts only while the health tree succeeds.
        healthy = verdict.state == "Healthy"
        found = self._observer.degraded_verdict(now=now, since=since) if healthy else Verdict("Starting", "", "", None)
        before = self._level.since
        debounce, clear_after = seconds(degraded.monitoring.debounce), seconds(degraded.clear_after)
        if self._level.note(found.state, clock, debounce=debounce, clear_after=clear_after):
            if found.state == "Failed":
                self._words = f"{found.reason}, in leaf {found.leaf} of spec.degraded"
            self._wait_for_idle(degraded.reschedule, found, clock, now=now, since=since)
            self._report_degraded(found.leaf, clock, entered=before is None)
            return
        self._idle_since, self._due = None, False
        if before is not None:
            self._report_well(clock - before)
        elif found.state == "Healthy" and self._notices.status.reason(CONDITION) != "Well":
            self._notices.condition(
                CONDITION, "False", "Well", "The active instance is not degraded: the tree of spec.degraded succeeds."
            )
        elif found.state == "Starting" and healthy and self._notices.status.find(CONDITION) is None:
            self._notices.condition(
                CONDITION,
                "Unknown",
                "Starting",
                f"It is not known yet whether the active instance is degraded: {found.reason}.",
            )

    # -- hand-over --------------------------------------------------------------------------------------------------

    def _wait_for_idle(
        self, reschedule: Reschedule | None, found: Verdict, clock: float, *, now: float, since: float
    ) -> None:
        """Note whether a hand-over is due, or else what it waits for.

        It may be due although the tree succeeds at the moment: some degradation shows only while the robot works.
        """
        self._due, self._waits = False, None
        if reschedule is None or found.state == "Starting":
            self._idle_since = None
            return
        busy = self._busy(now=now, since=since)
        if busy is not None:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = clock
        self._waits = busy or self._too_early(reschedule, clock)
        if self._waits is None:
            self._due, self._waits = True, self._lacking

    def _too_early(self, reschedule: Reschedule, clock: float) -> BusyReason | None:
        if self._paused(seconds(reschedule.pause), clock) > 0:
            return BusyReason("pause", f"the last planned switchover was less than {reschedule.pause} ago")
        since, idle = self._level.since, self._idle_since
        assert since is not None, "asked only if the instance is degraded"
        assert idle is not None, "asked only if the robot is idle"
        if clock < since + seconds(reschedule.after):
            return BusyReason("after", f"the instance must be degraded for {reschedule.after} first")
        if clock < idle + seconds(reschedule.idle_for):
            return BusyReason("idleFor", f"the robot must be idle for {reschedule.idle_for} first")
        return None

    def _busy(self, *, now: float, since: float) -> BusyReason | None:
        """Return why the robot does not count as idle; None if it does. It is busy too if the action proxy has a goal, or if the
        proxy's tasks are unknown."""
        proxied = self._notices.status.find(TASKS)
        if proxied is not None and proxied.status != "True":
            return BusyReason(
                "tasks", f"the state of its tasks is unknown ({TASKS} is {proxied.status}, {proxied.reason})"
            )
        if goals := self._notices.status.goals:
            return BusyReason("task", f"a goal of {goals[0]} is active")
        return self._observer.busy(now=now, since=since)

    def _paused(self, pause: float, clock: float) -> float:
        """Return the seconds until the next planned hand-over may begin. The last one of an earlier monitor is read from
        the status."""
        waits = [0.0]
        if self._handed_over is not None:
            waits.append(self._handed_over + pause - clock)
        if (recorded := self._notices.status.planned) is not None:
            waits.append(recorded + pause - time.time())
        return max(waits)

    # -- reporting --------------------------------------------------------------------------------------------------

    def _report_degraded(self, leaf: str, clock: float, *, entered: bool) -> None:
        if entered:
            self._notices.add(BecameDegraded())
            _logger.warning("degraded: %s", self._words)
            self._notices.event("Warning", "Degraded", self._words)
        before = self._reported[0]
        report = (leaf or before, self._waits.kind if self._waits is not None else "")
        if not self._words or (not entered and report == self._reported and clock - self._reported_at < AGAIN):
            return
        self._reported_at, self._reported = clock, report
        waits = f"{_WAITS}{self._waits.words}." if self._waits is not None else ""
        self._notices.condition(CONDITION, "True", "NotWell", f"{self._words}.{waits}")

    def _report_well(self, length: float) -> None:
        text = f"The tree of spec.degraded succeeds again, {length:.0f} s after it began to fail"
        _logger.info("%s", text)
        self._notices.condition(CONDITION, "False", "Well", f"{text}.")
        self._notices.event("Normal", "WellAgain", text)
