"""The report stage of one workload, assembled from its parts."""

from __future__ import annotations

from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.stage import ActStage
from understudy.monitor.decide.stage import DecideStage
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.notices import Notices
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.report.recovery_report import RecoveryReport
from understudy.monitor.report.status_conditions import StatusConditions


class ReportStage:
    """Reports the results of the other stages in the status and in Events."""

    def __init__(
        self,
        cluster: Cluster,
        observer: HealthObserver,
        decide: DecideStage,
        act: ActStage,
        notices: Notices,
    ) -> None:
        self.notices = notices
        self.recovery = RecoveryReport(cluster.gate, notices)
        self.status_conditions = StatusConditions(
            cluster, observer, act.safety, decide.options, decide.sole_driver, notices
        )

    def judged(self, judgement: Judgement) -> None:
        """Report the health of the active instance."""
        self.status_conditions.judged(judgement)
