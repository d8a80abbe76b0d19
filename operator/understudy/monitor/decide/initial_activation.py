"""Opens the gate for the first pod while no instance is active and no recovery is in progress."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence

import aiohttp

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import GateStatus
from understudy.failover.abandoned import ended
from understudy.failover.decide import Activate, Facts, Occurrence, Requirement, Trigger, decide
from understudy.failover.interfaces import Gate, Instance, Instances, Superseded
from understudy.failover.limits.state import InForce, LimitsInForce
from understudy.kube.client import ApiError
from understudy.monitor.decide.pause_state import Pauses
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import Sidecars

_logger = logging.getLogger(__name__)

ASK_AGAIN = 2.0
"""Seconds until a pod is requested again, if none runs."""


class Opening:
    """Opens the gate of one workload while it is closed. Times are unix seconds."""

    def __init__(self, fleet: Instances, gate: Gate, sidecars: Sidecars, notices: Notices, pauses: Pauses) -> None:
        self._fleet, self._gate, self._sidecars = fleet, gate, sidecars
        self._notices, self._pauses = notices, pauses
        self._started = time.time()
        self._next_asked = 0.0

    async def look(self, policy: FailurePolicySpec, now: float) -> bool:
        """Open the gate for a pod that runs, the workload's own pod first; return whether it was opened."""
        running = [i for i in self._fleet.of_workload() if i.usable and not i.held]
        self._notices.set(
            active="", health="Starting" if running else "Unknown", gate=GateStatus(epoch=self._gate.state.epoch)
        )
        ready = self._ready(running, policy, now)
        pause = self._pauses.on
        limits = LimitsInForce(pause=InForce(pause.words, pause.end) if pause is not None else None)
        unmet = None if ready else Requirement("NoPodReady" if running else "NoPodRunning")
        decision = decide(Facts(now, (Occurrence(Trigger.INITIAL_ACTIVATION, unmet=unmet),), limits))
        if decision.reason == "NoPodRunning":
            await self._ask_for_one(now)
        return isinstance(decision, Activate) and await self._open(ready)

    def _ready(self, running: Sequence[Instance], policy: FailurePolicySpec, now: float) -> Sequence[Instance]:
        """Return the pods that the gate may open for now.

        An application may need an answer of the robot before its outputs flow, and the workload's own pod comes before a standby: but
        neither is waited for longer than half of the policy's startupGrace.
        """
        ready = [i for i in running if not i.has_agent or self._sidecars.is_ready(i)[0]]
        if running and self._pauses.on is None:
            self._started = min(self._started, now)  # the clock may have been set back
        if now - self._started <= seconds(policy.monitoring.startup_grace) / 2:
            return [i for i in ready if i.from_source]
        return ready or running

    async def _open(self, ready: Sequence[Instance]) -> bool:
        first = min(ready, key=lambda i: (not i.from_source, i.created, i.name))
        # A recovery that closed the gate and did not succeed is not continued, but the other pods that failed still count as failed.
        left = self._gate.state.recovery
        if left is not None:
            failed = [pod for pod in left.failed if pod.uid != first.uid]
            left = ended(left).model_copy(update={"failed": failed})
        try:
            await self._gate.commit(first, left)
        except (Superseded, ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            _logger.warning("opening the gate for %s: %s", first.name, error)
            await asyncio.sleep(1)
            return False
        _logger.info("gate opened for %s, epoch %d", first.name, self._gate.state.epoch)
        self._notices.event("Normal", "InControl", f"{first.name} is in control, epoch {self._gate.state.epoch}")
        return True

    async def _ask_for_one(self, now: float) -> None:
        """Have the workload's own controller run a pod. It may have been scaled to none while a pod of a shared pool was active, and
        nobody else scales it up while the gate is closed.
        """
        if now < self._next_asked <= now + ASK_AGAIN:  # later than that if the clock was set back
            return
        self._next_asked = now + ASK_AGAIN
        try:
            async with asyncio.timeout(ASK_AGAIN):
                await self._fleet.replace([])
        except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            _logger.warning("no pod runs, and requesting one failed: %r", error)
