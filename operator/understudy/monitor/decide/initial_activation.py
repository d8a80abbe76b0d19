"""Puts the first pod in control where none is, and none is being recovered."""

from __future__ import annotations

import asyncio
import logging
import time

import aiohttp

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import GateStatus
from understudy.failover.abandoned import ended
from understudy.failover.interfaces import Gate, Superseded
from understudy.kube.client import ApiError
from understudy.monitor.act.pod_control import Fleet
from understudy.monitor.decide.pause_state import Pauses
from understudy.monitor.observe.agent_connections import Sidecars
from understudy.monitor.report.reporter import Reporter

_logger = logging.getLogger(__name__)

ASK_AGAIN = 2.0
"""Seconds before a pod is asked for again, where none runs."""


class Opening:
    """Opens the gate of one workload while it is closed. Times are unix seconds."""

    def __init__(self, fleet: Fleet, gate: Gate, sidecars: Sidecars, reporter: Reporter, pauses: Pauses) -> None:
        self._fleet, self._gate, self._sidecars = fleet, gate, sidecars
        self._reporter, self._pauses = reporter, pauses
        self._started = time.time()
        self._next_asked = 0.0

    async def look(self, policy: FailurePolicySpec, now: float) -> bool:
        """Open the gate for a pod that runs, its controller's first; whether it was opened."""
        running = [i for i in self._fleet.of_workload() if i.usable and not i.held]
        self._reporter.set(
            active="", health="Starting" if running else "Unknown", gate=GateStatus(epoch=self._gate.state.epoch)
        )
        if self._pauses.on is not None:
            return False
        if not running:
            await self._ask_for_one(now)
            return False
        ready = [i for i in running if not i.has_agent or self._sidecars.is_ready(i)[0]]
        self._started = min(self._started, now)  # the clock may have been set back
        # An application may need an answer of the robot before its outputs flow, and the workload's own pod comes before
        # a standby: but neither is waited for too long.
        if now - self._started <= seconds(policy.monitoring.startup_grace) / 2:
            ready = [i for i in ready if i.from_source]
        elif not ready:
            ready = running
        if not ready:
            return False
        first = min(ready, key=lambda i: (not i.from_source, i.created, i.name))
        # A recovery that closed it and came to nothing isn't gone on with, but which other pods had failed is still true.
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
        self._reporter.event("Normal", "InControl", f"{first.name} is in control, epoch {self._gate.state.epoch}")
        return True

    async def _ask_for_one(self, now: float) -> None:
        """No pod runs and no recovery is under way. The workload's own controller may have been told to run none, while a pod of
        a shared pool drove: nobody else tells it otherwise while the gate is closed.
        """
        if now < self._next_asked <= now + ASK_AGAIN:  # later than that by a clock that was set back since
            return
        self._next_asked = now + ASK_AGAIN
        try:
            async with asyncio.timeout(ASK_AGAIN):
                await self._fleet.replace([])
        except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            _logger.warning("no pod runs, and none can be asked for: %r", error)
