"""Deletes what recoveries left behind: claimed pods that nobody prepares, and failed pods whose deletion failed.

A claim may succeed after its monitor gave up, or died together with its journal. Such a pod is useless: it belongs to
this workload, but no recovery knows it and no pool counts it. A failed pod would be counted as a standby and prevent
a new one.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence

from understudy.failover.interfaces import Instance
from understudy.failover.progress import PodIdentity
from understudy.kube.client import FAILURES
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.notices import Notices

_logger = logging.getLogger(__name__)

LEFT_FOR = 30.0
"""Minimum seconds that a claimed pod was not active before it is deleted. Another monitor of this workload, which is
about to replace this one, may be preparing the pod."""


FAILED_FOR = 2.0
"""Seconds after which a failed pod is deleted again. The monitor may take that long to see the first deletion."""


class GarbageCollection:
    """Pods of one workload that are not active and have no use."""

    def __init__(self, fleet: PodControl, gate: GateControl, notices: Notices) -> None:
        self._fleet, self._gate, self._notices = fleet, gate, notices
        self._since: dict[str, float] = {}
        self._failed: dict[str, PodIdentity] = {}
        """Pods that failed in the last recovery, or in one before, by UID."""
        self._deleting: asyncio.Task[None] | None = None

    def remember(self) -> None:
        """Note the pods that the recovery in the gate's record replaced, before the next commit replaces that record.

        If a user fenced the robot during a planned switchover, the former instance is one of them, unless it gets control again.
        """
        recovery = self._gate.state.recovery
        if recovery is not None:
            self._failed |= {pod.uid: pod for pod in (*recovery.failed, recovery.former) if pod is not None}

    def add(self, pod: PodIdentity) -> None:
        """Add a pod that failed, or that was prepared and is not needed."""
        self._failed[pod.uid] = pod

    def failed(self) -> list[PodIdentity]:
        """Return the pods that failed in earlier recoveries and still exist. The next recovery deletes them too,
        whichever monitor finishes it."""
        self.remember()
        active = self._gate.state.active_uid
        there = {i.uid for i in self._fleet.of_workload() if i.usable}
        return [pod for uid, pod in self._failed.items() if uid in there and uid != active]

    def housekeeping(self, instances: Sequence[Instance], now: float) -> None:
        """Delete unused pods in the background; called while no recovery is under way. ``now`` is monotonic. Returns at
        once."""
        state = self._gate.state
        in_use = (state.active_uid, state.admitted_uid)
        self.remember()
        there = {i.uid for i in instances if i.uid not in in_use}
        self._failed = {uid: pod for uid, pod in self._failed.items() if uid in there}
        left = [
            i
            for i in instances
            if not i.terminating
            and i.uid not in in_use
            and not state.closed
            and (i.claim or (i.uid in self._failed and i.usable))
        ]
        self._since = {i.uid: self._since.get(i.uid, now) for i in left}
        due = [i for i in left if now - self._since[i.uid] >= (FAILED_FOR if i.uid in self._failed else LEFT_FOR)]
        if due and (self._deleting is None or self._deleting.done()):
            self._deleting = asyncio.create_task(self._delete(due))

    async def _delete(self, due: Sequence[Instance]) -> None:
        for instance in due:
            with contextlib.suppress(*FAILURES):
                # The watched state of the gate may be outdated.
                if await self._gate.lets_through(instance):
                    continue
                await self._fleet.retire(instance)
                _logger.warning("deleted %s, which a recovery left behind", instance.name)
                why = "has failed" if instance.uid in self._failed else "was claimed by a recovery that did not succeed"
                self._notices.event("Normal", "LeftoverDeleted", f"deleted {instance.name}, which {why}")
