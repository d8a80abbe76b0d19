"""The queue for pods of shared pools: which workloads wait, according to the records at their gates, and reports about
this workload's wait."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import chain

from understudy.api import names
from understudy.clock import CLOCK
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import waiter
from understudy.kube.watched_collection import any_changed
from understudy.monitor.notices import Notices, PodAwaited
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

REASON = "WaitingForPod"
"""Why a recovery does not continue, in the condition Recovering."""


class PoolQueue:
    """Implements :class:`understudy.failover.pool_queue.Queue` over the gates of the namespace."""

    def __init__(self, view: ClusterView, notices: Notices) -> None:
        self._view, self._notices = view, notices
        self._before = ("", "")
        """Reason and message of the condition Recovering when the wait began."""

    @property
    def workload(self) -> str:
        """This monitor's own workload."""
        return self._view.workload

    @property
    def priority(self) -> int:
        """The workload's ``spec.poolPriority``."""
        spec = self._view.spec
        return spec.pool_priority if spec is not None else 0

    def others(self, pool: str) -> Sequence[Waiter]:
        """Return the other workloads that wait for a pod of a pool."""
        found = []
        for name, gate in chain.from_iterable(one.items.items() for one in self._view.waiting_gates):
            metadata = gate["metadata"]
            if (metadata.get("labels") or {}).get(names.WAITS_FOR) != pool:
                continue
            other = waiter((metadata.get("annotations") or {}).get(names.RECOVERY, ""))
            # A monitor writes only its own gate, so a record for another workload is not valid.
            if other is not None and other.workload != self.workload and names.gate(other.workload) == name:
                found.append(other.moved(-CLOCK.step()))
        return found

    def waits(self, me: Waiter, ahead: int, of: int) -> None:
        """Report the wait in the condition Recovering, and its start in an Event too."""
        found = self._notices.status.find("Recovering")
        began = found is None or found.reason != REASON
        if began:
            self._before = (found.reason, found.message) if found is not None else ("FailureDetected", "")
        place = f"position {ahead + 1} of {of}, poolPriority {me.priority}"
        text = (
            f"{self._before[1]}; the workload has waited for a pod of FallbackPool {me.pool} since {_clock(me.since)}"
        )
        text = f"{text} ({place}), and waits until {_clock(me.until)} at the latest"
        self._notices.condition("Recovering", "True", REASON, text)
        if began:
            _logger.warning("%s", text)
            self._notices.event("Warning", REASON, text)

    def served(self, me: Waiter, pod: str) -> None:
        """Report that the recovery continues with a pod."""
        self._end(me, "Served", f"claimed {pod} after %.1f s in the queue of FallbackPool {me.pool}")

    def gave_up(self, me: Waiter) -> None:
        """Report that the recovery continues without a pod."""
        self._end(me, "GaveUp", f"got no pod of FallbackPool {me.pool} in %.1f s")

    def _end(self, me: Waiter, result: str, words: str) -> None:
        waited = CLOCK.now() - me.since
        self._notices.add(PodAwaited(me.pool, result, waited))
        if self._notices.status.reason("Recovering") == REASON:
            reason, message = self._before
            self._notices.condition("Recovering", "True", reason, f"{message}; {words % waited}")

    async def changed(self, pool: str) -> None:
        """Return when the unclaimed pods or the waiting workloads may have changed."""
        await any_changed((self._view.unclaimed(pool), *self._view.waiting_gates))


def _clock(moment: float) -> str:
    return datetime.fromtimestamp(CLOCK.to_system(moment), UTC).strftime("%H:%M:%S UTC")
