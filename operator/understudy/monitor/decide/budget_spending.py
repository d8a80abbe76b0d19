"""Counts and reports how much of the policy's budget of recoveries (``limits.budget``) is spent.

The workload's status contains the count, and is written with the record of each recovery. So a healthy workload costs no
writes, and the next monitor knows the count.
"""

from __future__ import annotations

import logging

from understudy.api import names
from understudy.api.kinds.failure_policy import Budget
from understudy.api.moments import in_words, unix
from understudy.clock import CLOCK
from understudy.failover.limits import budget as budgets
from understudy.failover.limits.state import ActiveLimit
from understudy.failover.progress import Progress
from understudy.monitor.notices import BudgetCounted, Notices, RecoveryDeferred
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

CONDITION = "WithinBudget"


class BudgetSpending:
    """The recoveries that one workload has spent. Times are Unix seconds."""

    def __init__(self, view: ClusterView, notices: Notices) -> None:
        self._view, self._notices = view, notices

    @property
    def _budget(self) -> Budget | None:
        policy = self._view.policy
        return policy.limits.budget if policy is not None else None

    @property
    def resumed(self) -> float | None:
        """When a user last asked to resume; None if never."""
        item = self._view.object
        resumed = ((item or {}).get("metadata", {}).get("annotations") or {}).get(names.RESUMED, "")
        return unix(resumed) if resumed else None

    def count(self, done: Progress, now: float) -> None:
        """Count a recovery that is over. Planned switchovers, reactions to the recovery of another workload, and recoveries in
        which no strategy was available do not count.
        """
        budget, tried = self._budget, any(attempt.result != "NotAvailable" for attempt in done.attempts)
        if budget is not None and tried and not done.planned and not done.follows:
            self._notices.set_spent([*self._counted(now), CLOCK.to_system(done.began)][-budget.recoveries :])
            self.report(now)

    def in_force(self, now: float) -> ActiveLimit | None:
        """Return the budget as a limit if it is spent; None if not."""
        if (budget := self._budget) is None:
            return None
        return budgets.in_force(budget, self._notices.status.spent, self.resumed, now)

    def spent_until(self, now: float) -> float | None:
        """Return until when the budget allows no recovery; None if it allows one now."""
        found = self.in_force(now)
        return found.until if found is not None else None

    def report(self, now: float) -> None:
        """Report the budget; withdraw the report if the policy has none."""
        budget = self._budget
        if budget is None:
            self._notices.add(BudgetCounted("", None))
            self._notices.set_spent([])
            self._notices.withdraw(CONDITION)
            return
        left = budgets.left(self._counted(now), now, recoveries=budget.recoveries, within=budget.length)
        self._notices.add(BudgetCounted(budget.within, left))
        if (until := self.spent_until(now)) is None:
            before = self._notices.status.find(CONDITION)
            text = f"limits.budget of the policy ({budget.words}) is not spent."
            if self._notices.condition(CONDITION, "True", "Left", text) and before is not None:
                self._notices.event("Normal", "BudgetLeft", "Failures are recovered automatically again")
            return
        text = self._spent(budget, until)
        if self._notices.condition(CONDITION, "False", "Spent", text):
            _logger.warning("%s", text)
            self._notices.event("Warning", "BudgetSpent", text)

    def report_held(self, progress: Progress) -> None:
        """Report that a failure is not recovered because the budget is spent."""
        found = self._notices.status.find(CONDITION)
        done = f"fenced {progress.failed[0].name}" if progress.failed else "closed the gate"
        why = found.message if found is not None else ""
        text = f"{progress.reason}. The monitor {done}, so no instance controls the robot. {why}"
        _logger.warning("%s", text)
        self._notices.add(RecoveryDeferred("BudgetSpent"))
        self._notices.condition("Recovering", "False", "BudgetSpent", text.strip())
        self._notices.event("Warning", "RecoveryHeld", text.strip())

    def _counted(self, now: float) -> list[float]:
        return budgets.counted(self._notices.status.spent, self.resumed, now)

    def _spent(self, budget: Budget, until: float) -> str:
        return (
            f"limits.budget of the policy is spent ({budget.words}). Until {in_words(until)}, the monitor fences an instance that "
            "fails, but does not replace it. To continue now, find the cause of the failures and run: "
            f"understudy resume -n {self._view.namespace} {self._view.workload}"
        )
