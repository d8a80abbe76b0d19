"""Ends what reaches the robot although the gate does not let it through: deletes its pod, and closes the gate until it is silent."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Sequence

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.abandoned import ended
from understudy.failover.interfaces import Instance, Superseded
from understudy.kube.client import FAILURES
from understudy.monitor.act.instances.stray_pods import StrayPods
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.judge.sole_driver import Leak, SoleDriver
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery

_logger = logging.getLogger(__name__)

END_AGAIN = 10.0
"""Seconds until a pod that still reaches the robot is deleted again."""

STANDBY_LASTS = 5.0
"""Seconds after which an instance that was never in control is deleted: the network may take some time with a new pod."""

STANDBY_AGAIN = 60.0
"""Minimum seconds between two deletions of instances that were never in control. If the network enforces nothing, every standby leaks, and
its replacement does too."""

STANDBY_ENDS = 2.0
"""Seconds that such an instance has to end once it is deleted: it has a second of grace. The gate closes only if it is heard later."""

CLOSE_WITHIN = 2.0
"""Seconds that the API server has to close the gate; then the loop goes on, and it is tried again."""

CLOSE_AGAIN = 1.0
"""Seconds after a request without success until the next one."""


class LeakResponse:
    """Responds to the leaks of one workload."""

    def __init__(
        self, fleet: PodControl, strays: StrayPods, gate: GateControl, sole_driver: SoleDriver, notices: Notices
    ) -> None:
        self._fleet, self._strays = fleet, strays
        self._gate, self._sole_driver, self._notices = gate, sole_driver, notices
        self._ended: dict[str, float] = {}
        self._standby_ended = self._close_after = -math.inf
        self._ending_standby = ""
        """UID of the instance that was deleted then."""
        self._ending: asyncio.Task[None] | None = None

    async def respond(self, policy: FailurePolicySpec, now: float) -> bool:
        """End the leaks, and close the gate if spec.onLeak is Close. Returns whether it was closed."""
        if not self._sole_driver.leaks:
            return False
        self._end(now, self._sole_driver.leaks)
        return policy.on_leak == "Close" and await self._close()

    def respond_during(self, current: CurrentRecovery, now: float) -> None:
        """End the leaks of the instances that failed in a recovery, or all of them while it is held, with the gate closed."""
        if current.progress is not None:
            progress, is_held = current.progress, current.held is not None
            self._end(now, [leak for leak in self._sole_driver.leaks if is_held or progress.has_failed(leak.uid)])

    def _end(self, now: float, leaks: Sequence[Leak]) -> None:
        """Delete leaking pods in the background."""
        due = self._due(leaks, now, time.monotonic())
        if due and (self._ending is None or self._ending.done()):
            self._ending = asyncio.create_task(self._delete(due))

    def _due(self, leaks: Sequence[Leak], unix: float, now: float) -> list[Instance]:
        """Return the pods to delete now. The instance for which the gate was closed is not to blame."""
        found: list[Instance] = []
        for leak in leaks:
            instance = self._fleet.find(leak.uid) or self._strays.find(leak.uid)
            if instance is None or leak.uid == self._sole_driver.rightful:
                continue
            if now - self._ended.get(leak.uid, -math.inf) < END_AGAIN:
                continue
            if not leak.is_former:
                is_new = unix - leak.first < STANDBY_LASTS
                if is_new or self._gate.state.closed or now - self._standby_ended < STANDBY_AGAIN:
                    continue
                self._standby_ended, self._ending_standby = now, leak.uid
            self._ended[leak.uid] = now
            found.append(instance)
        return found

    async def _delete(self, due: Sequence[Instance]) -> None:
        for instance in due:
            with contextlib.suppress(*FAILURES):
                # The watched state of the gate may be outdated.
                if await self._gate.lets_through(instance):
                    continue
                await self._fleet.end(instance)
                words = f"deleted {instance.name}, which reached the robot although the gate does not let it through"
                _logger.warning(words)
                self._notices.event("Warning", "LeakingPodDeleted", words)

    def _ends(self, leak: Leak, now: float) -> bool:
        """Whether a leak is a deleted standby that was not heard any more once it had the time to end."""
        return leak.uid == self._ending_standby and now - self._standby_ended - leak.silent < STANDBY_ENDS

    async def _close(self) -> bool:
        """Close the gate if an instance that was in control before reaches the robot beside the active one."""
        state, now = self._gate.state, time.monotonic()
        former = {
            leak.uid: leak.name
            for leak in self._sole_driver.leaks
            if leak.is_former and leak.goes_on and leak.uid != state.active_uid and not self._ends(leak, now)
        }
        if state.closed or not former or now < self._close_after:
            return False
        # The recovery that opened the gate is over, but the pods that failed in it still count as failed.
        left = ended(state.recovery) if state.recovery is not None else None
        try:
            async with asyncio.timeout(CLOSE_WITHIN):
                identities = self._sole_driver.identities()
                await self._gate.commit(None, left, leaking=identities, against=former.keys())
        except (Superseded, *FAILURES) as error:
            _logger.warning("could not close the gate for %s: %r", state.active, error)
            self._close_after = time.monotonic() + CLOSE_AGAIN
            return False
        self._sole_driver.close_for(state.active_uid)
        leaking = ", ".join(former.values())
        words = f"the gate is closed for {state.active}, because {leaking} still reaches the robot; it opens again after that"
        _logger.warning(words)
        self._notices.event("Warning", "GateClosedForLeak", words)
        return True
