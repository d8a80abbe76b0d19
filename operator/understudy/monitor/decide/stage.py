"""The decide stage of one workload: its parts, put together."""

from __future__ import annotations

from understudy.failover.strategies.base import Means
from understudy.monitor.decide.deferred_failures import Postponing
from understudy.monitor.decide.initial_activation import Opening
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.planned_triggers import Occasions
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.stage import JudgeStage
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import Sidecars
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.dependencies import Dependencies


class DecideStage:
    """What should happen now: the limits, the policy's strategies, and what is due though nothing has failed."""

    def __init__(
        self,
        view: View,
        sidecars: Sidecars,
        means: Means,
        judge: JudgeStage,
        dependencies: Dependencies,
        notices: Notices,
    ) -> None:
        """``means`` are what strategies work with, before the workload's settings and policy are known."""
        self.limits = Limits(view, notices)
        self.repertoire = Repertoire(view, self.limits.storms, means)
        self.postponing = Postponing(notices, self.limits, self.repertoire)
        self.occasions = Occasions(view, judge.levels, dependencies, self.repertoire, self.limits)
        self.opening = Opening(means.instances, means.gate, sidecars, notices, self.limits.pauses)
