"""Supervises waiting instances: has each prepared for its role, and gives standbys the kept state."""

from __future__ import annotations

import time
from collections.abc import Sequence

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.interfaces import Agents, Instance
from understudy.monitor.act.instances.standby_lifecycle import StandbyLifecycle
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.judge.unseen_restart import UnseenRestart
from understudy.monitor.notices import Notices
from understudy.monitor.observe.senses import Senses


class StandbySupervision:
    """The standbys of one workload, and other instances that are not prepared yet."""

    def __init__(
        self,
        cluster: Cluster,
        senses: Senses,
        state_manager: StateManager,
        unseen_restart: UnseenRestart,
        notices: Notices,
    ) -> None:
        self._cluster, self._agents, self._roles, self._current = cluster, senses.agents, senses.roles, senses.current
        self._state_manager, self._unseen_restart = state_manager, unseen_restart
        self._bringing = StandbyLifecycle(cluster.pods, senses.agents, senses.roles, notices)

    def housekeeping(
        self, instances: Sequence[Instance], policy: FailurePolicySpec, settings: WorkloadSettings, *, paused: bool
    ) -> None:
        """Prepare these instances and give standbys state; during a pause, do neither. Returns at once."""
        if not paused:
            self._bring(instances, policy, settings)
        active_uid = self._cluster.gate.state.active_uid
        targets = receivers(instances, settings, self._agents, active_uid=active_uid) if not paused else []
        active = self._cluster.pods.find(active_uid)
        source = self._unseen_restart.source(active) if active is not None else None
        self._state_manager.housekeeping(active, targets, source)

    def _bring(self, instances: Sequence[Instance], policy: FailurePolicySpec, settings: WorkloadSettings) -> None:
        if (spec := self._cluster.view.spec) is None:
            return
        held = self._current.held
        cared = [i for i in instances if held is None or not held.has_failed(i.uid)]
        self._bringing.housekeeping(
            cared, policy, spec, settings, self._roles.driver, lambda: self._state_manager.select(time.time())
        )


def receivers(
    instances: Sequence[Instance], settings: WorkloadSettings, agents: Agents, *, active_uid: str
) -> list[tuple[Instance, float]]:
    """Return the standbys that get state while they wait (``keepUp`` of their pool), each with its period in seconds."""
    periods = {pool.name: seconds(pool.keep_up) for pool in settings.pools if pool.keep_up}
    if not periods:
        return []
    # A pod of the workload's own controller is a standby like the pods of pools.
    return [
        (instance, periods.get(instance.pool, min(periods.values())))
        for instance in instances
        if instance.uid != active_uid and instance.usable and instance.has_agent and not instance.held
        if (not instance.pool or instance.pool in periods) and agents.is_ready(instance)[0]
    ]
