"""Begins the recovery of a failure: which pods failed, what is prepared already, and which strategy has its turn."""

from __future__ import annotations

from understudy.failover import reflex
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.act.garbage_collection import Leftovers
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.act.reflex_guard import Reflexes
from understudy.monitor.decide.retry_backoff import Retries
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.observe import dependencies


class RecoveryStart:
    """Begins the recoveries of one workload."""

    def __init__(
        self, cluster: Cluster, switchovers: Switching, leftovers: Leftovers, retries: Retries, reflexes: Reflexes
    ) -> None:
        self._view, self._gate = cluster.view, cluster.gate
        self._switchovers, self._leftovers, self._retries = switchovers, leftovers, retries
        self._reflexes = reflexes

    def begin(self, failure: Failure) -> Progress | None:
        """Return the record of the recovery that begins; None if none may begin yet, since every strategy's instance failed at once."""
        prepared = self._switchovers.failed(failure.reason)
        state = self._gate.state
        failed = [PodIdentity(name=state.active, uid=state.active_uid)] if not state.closed else []
        if failure.taken is not None:
            return reflex.begin(failure.taken, failed[0], self._reflexes.deadline)
        if failure.follows and failed:
            if prepared is not None:
                self._leftovers.add(prepared)
            onset, detected = failure.onset, failure.detected
            return dependencies.begin(failure.follows, failed[0], self._view.spec, onset=onset, detected=detected)
        progress = Progress.begin(
            failure.reason,
            last_healthy=failure.onset,
            detected=failure.detected,
            failed=[*failed, *self._leftovers.failed()],
            planned=failure.planned,
        )
        progress.target = prepared
        if (first := self._retries.first(failure.reason, failure.onset, state.active_uid)) is None:
            return None
        progress.index = first
        return progress
