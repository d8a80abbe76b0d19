"""The report stage of one workload, assembled from its parts."""

from __future__ import annotations

from understudy.failover.interfaces import Gate
from understudy.monitor.act.stage import ActStage
from understudy.monitor.decide.stage import DecideStage
from understudy.monitor.judge.sole_driver import SoleDriver
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.report.recovery_report import RecoveryReport
from understudy.monitor.report.status_conditions import StatusConditions


class ReportStage:
    """Reports the results of the other stages in the status and in Events."""

    def __init__(
        self,
        view: ClusterView,
        gate: Gate,
        observer: HealthObserver,
        decide: DecideStage,
        act: ActStage,
        sole_driver: SoleDriver,
        notices: Notices,
    ) -> None:
        self.notices = notices
        self.recovery = RecoveryReport(gate, notices)
        self.status_conditions = StatusConditions(
            view, gate, observer, act.safety, decide.options, sole_driver, notices
        )

    def judged(self, judgement: Judgement) -> None:
        """Report the health of the active instance."""
        self.status_conditions.judged(judgement)
