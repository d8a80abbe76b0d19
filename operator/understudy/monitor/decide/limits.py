"""The limits of the monitor's workload, and which of them are in force."""

from __future__ import annotations

import time

from understudy.failover.decide import Facts, Hold, Occurrence, Trigger, decide
from understudy.failover.limits.state import ActiveLimit, LimitsInForce
from understudy.monitor.decide.budget_spending import BudgetSpending
from understudy.monitor.decide.pause_state import PauseState
from understudy.monitor.decide.retry_backoff import RetryBackoff
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.storm_condition import StormCondition
from understudy.monitor.outcome import Outcome


class Limits:
    """The limits of one workload. Their order of precedence is in ``failover/decide.py``."""

    def __init__(self, view: ClusterView, notices: Notices) -> None:
        self.pauses = PauseState(view, notices)
        self.spending = BudgetSpending(view, notices)
        self.storms = StormCondition(view)
        self.retries = RetryBackoff(view, notices)

    def conclude(self, outcome: Outcome) -> None:
        """Count a recovery that is over, and defer the next one. A planned switchover does not defer the next recovery."""
        progress, policy = outcome.progress, outcome.policy
        if outcome.kind in ("Superseded", "NoLongerNeeded"):
            self.retries.after(0.0)
        elif outcome.kind == "Stopped":
            self.retries.after_error()
        elif policy is not None:
            self.retries.note(progress)
            self.spending.count(progress, time.time())
            if outcome.kind == "Recovered":
                self.retries.after_recovery(policy)
            else:
                self.retries.after_nothing_verified(policy)

    def hold(self, trigger: Trigger, now: float) -> bool:
        """Return whether a limit holds a recovery that is decided on, or that already fenced the failed instance."""
        return isinstance(decide(Facts(now, (Occurrence(trigger),), self.in_force(now))), Hold)

    def in_force(self, now: float) -> LimitsInForce:
        """Return the limits that are in force at a time (Unix seconds). The pause is as of the last update."""
        pause = self.pauses.on
        return LimitsInForce(
            pause=ActiveLimit(pause.words, pause.end) if pause is not None else None,
            waiting=self.retries.in_force(now),
            storm=self.storms.on(now),
            budget=self.spending.in_force(now),
        )
