"""What keeps one workload from being recovered, or anything else from being begun: a pause, the budget, a storm, the last recovery."""

from __future__ import annotations

from understudy.monitor.decide.budget_spending import Spending
from understudy.monitor.decide.pause_state import Pauses
from understudy.monitor.decide.retry_backoff import Retries
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.storm_condition import Storms
from understudy.monitor.report.reporter import Reporter


class Limits:
    """The limits of one workload. Which of them matter to what, and in which order, whoever asks knows."""

    def __init__(self, view: View, reporter: Reporter) -> None:
        self.pauses = Pauses(view, reporter)
        self.spending = Spending(view, reporter)
        self.storms = Storms(view)
        self.retries = Retries(view, reporter)
