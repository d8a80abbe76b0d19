"""Looks after the instances that wait: what each of them is to be, that it becomes so, and that what is of no use is deleted."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.interfaces import Gate, Instance
from understudy.monitor.act.garbage_collection import Leftovers
from understudy.monitor.act.pod_control import Fleet
from understudy.monitor.act.recovery_in_progress import UnderWay
from understudy.monitor.act.standby_lifecycle import Bringing, expected, managed
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.observe.agent_connections import Sidecars
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.report.reporter import Reporter


class Standbys:
    """The standbys of one workload, and whoever else has yet to be brought to where it belongs."""

    def __init__(
        self,
        view: View,
        fleet: Fleet,
        gate: Gate,
        sidecars: Sidecars,
        keeping: StateKeeping,
        reporter: Reporter,
        leftovers: Leftovers,
        under_way: UnderWay,
    ) -> None:
        self._view, self._fleet, self._gate = view, fleet, gate
        self._sidecars, self._keeping = sidecars, keeping
        self._leftovers, self._under_way = leftovers, under_way
        self._bringing = Bringing(fleet, sidecars, reporter)

    @property
    def driver(self) -> str:
        """The UID of the pod by which the others are standbys: while a failure is held nobody is to take its place."""
        held = self._under_way.held
        return held.failed[0].uid if held is not None and held.failed else self._gate.state.active_uid

    def role(self, instance: Instance, brought: str) -> tuple[Mapping[str, Any] | None, bool]:
        """What an instance must be to be ready while it waits, and whether procedures bring its nodes up."""
        policy, spec, settings = self._view.policy, self._view.spec, self._view.settings
        if policy is None or spec is None or settings is None:
            return None, False
        ready = self._bringing.was_ready(instance) or self._sidecars.is_ready(instance)[0]
        found = expected(instance, spec, settings, active_uid=self.driver, brought=brought, ready=ready)
        return found.standby, managed(spec, settings, policy)

    def housekeeping(
        self, instances: Sequence[Instance], policy: FailurePolicySpec, settings: WorkloadSettings, *, paused: bool
    ) -> None:
        """Look at every instance that is nobody else's; in a pause nothing is done to any of them. Returns at once."""
        if not paused:
            self._bring(instances, policy, settings)
            self._leftovers.housekeeping(instances, time.monotonic())
        kept_up = self._kept_up(instances, settings) if not paused else []
        self._keeping.housekeeping(self._fleet.find(self._gate.state.active_uid), kept_up)

    def _bring(self, instances: Sequence[Instance], policy: FailurePolicySpec, settings: WorkloadSettings) -> None:
        if (spec := self._view.spec) is None:
            return
        held = self._under_way.held
        cared = [i for i in instances if held is None or not held.has_failed(i.uid)]
        self._bringing.housekeeping(
            cared, policy, spec, settings, self.driver, lambda: self._keeping.select(time.time())
        )

    def _kept_up(self, instances: Sequence[Instance], settings: WorkloadSettings) -> list[tuple[Instance, float]]:
        """The standbys that are given state while they wait, each with its period in seconds."""
        periods = {pool.name: seconds(pool.keep_up) for pool in settings.pools if pool.keep_up}
        if not periods:
            return []
        active = self._gate.state.active_uid
        # One that the workload's own controller made is a standby like the pool's.
        return [
            (instance, periods.get(instance.pool, min(periods.values())))
            for instance in instances
            if instance.uid != active and instance.usable and instance.has_agent and not instance.held
            if (not instance.pool or instance.pool in periods) and self._sidecars.is_ready(instance)[0]
        ]
