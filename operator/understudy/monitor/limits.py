"""What keeps one workload from being recovered, or anything else from being begun: a pause, the budget, a storm, the last recovery."""

from __future__ import annotations

from understudy.monitor.budgeting import Spending
from understudy.monitor.pausing import Pauses
from understudy.monitor.reporting import Reporter
from understudy.monitor.retries import Retries
from understudy.monitor.storms import Storms
from understudy.monitor.view import View


class Limits:
    """The limits of one workload. Which of them matter to what, and in which order, whoever asks knows."""

    def __init__(self, view: View, reporter: Reporter) -> None:
        self.pauses = Pauses(view, reporter)
        self.spending = Spending(view, reporter)
        self.storms = Storms(view)
        self.retries = Retries(view, reporter)
