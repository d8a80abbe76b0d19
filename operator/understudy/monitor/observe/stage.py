"""The observe stage of one workload: its parts, put together."""

from __future__ import annotations

from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.dependencies import Dependencies
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import EvaluationSchedule


class ObserveStage:
    """When the monitor evaluates, and what."""

    def __init__(self, view: ClusterView, senses: Senses, notices: Notices) -> None:
        self.schedule = EvaluationSchedule(senses.wakeups, senses.observer.coming)
        self.dependencies = Dependencies(view, notices, senses.wakeups)
        self.senses = senses
