"""The observe stage of one workload, assembled from its parts."""

from __future__ import annotations

from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.dependencies import Dependencies
from understudy.monitor.observe.objects.other_monitors import OtherMonitors
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import EvaluationSchedule


class ObserveStage:
    """The schedule of evaluations, and the sources of observations."""

    def __init__(self, view: ClusterView, senses: Senses, notices: Notices) -> None:
        self.schedule = EvaluationSchedule(senses.wakeups, senses.observer.coming)
        self.dependencies = Dependencies(view, notices, senses.wakeups)
        self.other_monitors = OtherMonitors(view)
        self.senses = senses
