"""Reports in the status: the workload's health, whether its topics are received, and the strategy that a recovery would use."""

from __future__ import annotations

from understudy.api.kinds.robot_workload import GateStatus, Health
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.safe_commands import SafeCommands
from understudy.monitor.decide.initial_activation import Candidates
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.judge.sole_driver import UNKNOWN_SENDER, SoleDriver
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.notices import Notices
from understudy.monitor.observe.robot.health_observer import HealthObserver


class StatusConditions:
    """Reports on one workload."""

    def __init__(
        self,
        cluster: Cluster,
        observer: HealthObserver,
        safety: SafeCommands,
        options: StrategyOptions,
        sole_driver: SoleDriver,
        notices: Notices,
    ) -> None:
        self._view, self._gate, self._observer, self._sole_driver = cluster.view, cluster.gate, observer, sole_driver
        self._safety, self._options, self._notices = safety, options, notices

    def judged(self, judgement: Judgement) -> None:
        """Report the health of the active instance."""
        state, verdict = self._gate.state, judgement.verdict
        if verdict is None:
            return
        leaks = self._sole_driver.leaks if judgement.healthy else ()
        strangers = self._sole_driver.strangers if judgement.healthy else ()
        self._notices.set(
            active=state.active,
            health="Degraded" if (judgement.degraded or leaks or strangers) and judgement.healthy else verdict.state,
            gate=GateStatus(epoch=state.epoch, active=state.active),
        )
        status = {"Healthy": "True", "Failed": "False", "Starting": "Unknown"}[verdict.state]
        if leaks:
            others = ", ".join(leak.name for leak in leaks)
            words = f"The health tree of {state.active} succeeds, but {others} reaches the robot too."
            self._notices.condition("Healthy", "False", "SeveralDrivers", words)
        elif strangers:
            words = f"The health tree of {state.active} succeeds, but an unknown sender reaches the robot too: {'; '.join(strangers)}."
            self._notices.condition("Healthy", "Unknown", UNKNOWN_SENDER, words)
        else:
            self._notices.condition("Healthy", status, verdict.state, verdict.reason)
        if judgement.settled and self._notices.status.reason("Recovering") not in ("", "Recovered", "HealthyAgain"):
            self._notices.condition("Recovering", "False", "HealthyAgain", f"{state.active} is healthy again.")

    def none_active(self, candidates: Candidates, *, recovering: bool = False) -> None:
        """Report that the gate is closed; ``recovering`` is whether another monitor carries out a recovery."""
        health: Health = "Recovering" if recovering else "Starting" if candidates.running else "Unknown"
        if self._sole_driver.leaks:
            health = "Failed"
        self._notices.set(active="", health=health, gate=GateStatus(epoch=self._gate.state.epoch))

    def housekeeping(self) -> None:
        """Report the values that change seldom. Policy and settings must be known."""
        usable = self._options.usable()
        item = self._view.object
        self._notices.observe(item["metadata"].get("generation") if item else None)
        self._notices.set(strategy=usable)
        self._report_watched()

    def _report_watched(self) -> None:
        if problems := [*self._observer.problems, *self._safety.problems]:
            reason = "TypeNotInstalled" if any("not installed" in problem for problem in problems) else "NotWatched"
            if self._notices.condition("Monitored", "False", reason, " ".join(problems)):
                self._notices.event("Warning", reason, " ".join(problems))
        elif waiting := self._observer.waiting:
            self._notices.condition("Monitored", "Unknown", "WaitingForTopics", " ".join(waiting))
        else:
            self._notices.condition("Monitored", "True", "Watching", self._observer.summary)
