"""Finds which of the policy's strategies could be carried out now."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace

from understudy.api.base import seconds
from understudy.failover.interfaces import NotAvailable
from understudy.failover.strategies.base import Choice, Strategy, StrategyContext
from understudy.failover.strategies.registry import choices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.storm_condition import StormCondition

CHECK_WITHIN = 0.5
"""Maximum seconds for the check whether a planned hand-over is possible."""

EXPIRY_MOST = 0.5
"""Longest lifespan in seconds whose end a recovery waits for. The messages of an output with a longer one, such as a map, stay right."""


class StrategyOptions:
    """The strategies of one workload's policy, and the resources that exist for them."""

    def __init__(self, view: ClusterView, storms: StormCondition, context: StrategyContext) -> None:
        """``context`` lacks the settings and policy of the workload, which :meth:`context` adds."""
        self._view, self._storms, self._context = view, storms, context

    def context(self) -> StrategyContext:
        """Return the context of strategies, with the present settings and policy."""
        policy, settings = self._view.policy, self._view.settings
        assert settings is not None, "the cluster view has started, so there are settings"
        restore_within = seconds(policy.state.within) if policy is not None else self._context.restore_within
        spec, valid = self._view.spec, []
        if spec is not None and not spec.gate.is_at_robot:  # a mux drops what an instance sent before it was in control
            valid = [output.valid_for(spec.gate.reflex) for output in spec.outputs if output.topic]
        expiry = max((length for length in valid if length <= EXPIRY_MOST), default=0.0)
        return replace(
            self._context, workload_uid=settings.uid, restore_within=restore_within, expiry=expiry, holds=self.holds
        )

    def choices(self) -> Sequence[Choice]:
        """Return the strategies in order, each with its time limit; empty while they are not known yet."""
        policy, settings = self._view.policy, self._view.settings
        if policy is None or settings is None:
            return ()
        return choices(policy, settings, self._view.spec)

    def usable(self) -> str:
        """Return the name of the strategy that would be carried out now, according to reports; ``None`` if none could."""
        context = self.context()
        reasons = [(choice.strategy, choice.strategy.available_as_reported(context)) for choice in self.choices()]
        return next((strategy.name.split("/")[-1] for strategy, reason in reasons if reason is None), "None")

    def standby_ready(self) -> bool:
        """Return whether a healthy instance is ready to take over that no other workload could use."""
        found = self.choices()
        if not found:
            return False
        context = self.context()
        return any(choice.strategy.has_own_instance and choice.strategy.available(context) is None for choice in found)

    def holds(self, strategy: Strategy) -> str | None:
        """Return why a storm prevents a strategy now; None if it does not."""
        if strategy.has_own_instance or (storm := self._storms.on(time.time())) is None:
            return None
        return f"deferred because other workloads fail too: {storm.words}"

    def first_missing(self) -> str | None:
        """Return why the first strategy cannot be carried out, according to reports; None if it can."""
        first = self.choices()[0].strategy
        return first.available_as_reported(self.context()) or self.holds(first)

    async def check_first(self) -> str | None:
        """Return why the first strategy cannot be carried out, according to the present state of the cluster and not
        only to reports; None if it can.

        The active instance is not watched during this check, so a slow answer counts as no answer.
        """
        first, context = self.choices()[0].strategy, self.context()
        try:
            async with asyncio.timeout(CHECK_WITHIN):
                await first.refresh(context)
            return first.available(context)
        except (NotAvailable, TimeoutError) as error:
            return str(error) or "the API server does not answer"
