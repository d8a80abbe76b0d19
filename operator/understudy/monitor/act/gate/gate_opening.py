"""Opens the gate for the first pod, or requests a pod if none runs."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from dataclasses import replace

from understudy.clock import CLOCK
from understudy.failover.abandoned import AbandonedRecovery, ended
from understudy.failover.interfaces import Instance, Instances, Superseded
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.steps import restore
from understudy.kube.client import FAILURES, NO_ANSWER
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.notices import Notices
from understudy.monitor.observe.last_driver import last_driver

_logger = logging.getLogger(__name__)

ASK_AGAIN = 2.0
"""Seconds until a pod is requested again, if none runs."""

OPEN_WITHIN = 2.0
"""Seconds that the API server has to open the gate. After that it is decided again: another instance may have been heard meanwhile."""

OPEN_AGAIN = 1.0
"""Seconds after a request without success until the next one."""

_CLOSED = "the gate was closed"
"""The reason in the record of an opening if no recovery closed the gate."""


class GateOpening:
    """Opens the gate of one workload while it is closed. Times are Unix seconds."""

    def __init__(
        self,
        fleet: Instances,
        gate: GateControl,
        options: StrategyOptions,
        state_manager: StateManager,
        notices: Notices,
    ) -> None:
        self._fleet, self._gate, self._notices = fleet, gate, notices
        self._options, self._state_manager = options, state_manager
        self._given: Instance | None = None
        """The instance that was given state last, as it was then."""
        self._dropped: Progress | None = None
        """The recovery that was not needed last."""
        self._next_asked = 0.0
        self._open_after = -math.inf
        """When the next request is due (monotonic seconds)."""
        self._is_sent = False
        """Whether a request had no answer, and may still be carried out."""

    async def open(self, first: Instance) -> None:
        """Open the gate for a pod, unless the last request was a moment ago."""
        if time.monotonic() < self._open_after:
            return
        left, last = self._left_to(first), self._last_driver()
        is_other = last is None or last.uid != first.uid
        if left is not None and is_other and self._is_to_be_given_state(first) and await self._give_state(first, left):
            return  # it is decided again: much may have happened meanwhile
        try:
            async with asyncio.timeout(OPEN_WITHIN):
                await self._gate.commit(first, left)
        except (Superseded, *FAILURES) as error:
            _logger.warning("could not open the gate for %s: %r", first.name, error)
            self._open_after = time.monotonic() + OPEN_AGAIN
            self._is_sent = self._is_sent or isinstance(error, NO_ANSWER)
            return
        self._is_sent = False
        _logger.info("gate opened for %s, epoch %d", first.name, self._gate.state.epoch)
        self._notices.event("Normal", "InControl", f"{first.name} is active, epoch {self._gate.state.epoch}")

    def _left_to(self, first: Instance) -> Progress | None:
        """Return the recovery that closed the gate, ended, as the record of an opening for ``first``; None if there was nothing to recover.

        The other pods that failed in it still count as failed. So does the one that drove last: it may have failed just before the gate
        closed for a leak.
        """
        left, last, now = self._gate.state.recovery or self._dropped_here(), self._last_driver(), CLOCK.now()
        failed = [] if left is None else [pod for pod in left.failed if pod.uid != first.uid]
        if last is not None and last.uid != first.uid:
            if left is None:
                left = Progress.begin(_CLOSED, last_healthy=now, detected=now)
            elif not left.has_failed(last.uid):
                left = left.model_copy(update={"moments": left.moments | {"last_healthy": now}})
            if last not in failed:
                failed.append(last)
        return None if left is None else ended(left).model_copy(update={"failed": failed, "open_at": None})

    def drop(self, progress: Progress) -> None:
        """Note a recovery that was not needed, because somebody deleted the gate: the failed instance may have failed nevertheless."""
        self._dropped = progress

    def _dropped_here(self) -> Progress | None:
        """Return the recovery that was dropped, if nobody has switched the gate since."""
        return self._dropped if self._dropped is not None and self._dropped.open_at == self._gate.state.epoch else None

    def _last_driver(self) -> PodIdentity | None:
        known = last_driver(self._gate.state, self._notices.status, self._fleet.of_workload())
        if known is not None:
            return known
        dropped = self._dropped_here()
        return dropped.failed[0] if dropped is not None and dropped.failed else None

    def _is_to_be_given_state(self, first: Instance) -> bool:
        given = self._given
        is_known = bool(self._options.choices())  # with the settings of the workload
        return is_known and (given is None or (given.uid, given.restarts) != (first.uid, first.restarts))

    async def _give_state(self, first: Instance, left: Progress) -> bool:
        """Give an instance the kept state: a recovery that failed left none, and its strategies are not carried out again.

        Returns whether that took time.
        """
        if self._gate.unanswered_since is not None:
            await self.settle()  # the gate cannot open before the API server answers
            return True
        context = self._options.context()
        target = PodIdentity(name=first.name, uid=first.uid)
        progress = left.model_copy(update={"target": target, "state": [], "moments": dict(left.moments)})
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(context.restore_within + OPEN_WITHIN):
                await restore(first, progress, replace(context, save=lambda progress: None))
        if self._gate.unanswered_since is not None:
            return True
        self._given = first
        if any(entry.restored for entry in progress.state):
            await asyncio.sleep(context.expiry)  # for commands that it sent before
        if progress.state:
            self._state_manager.report_restored(progress.to_recovery(0))
        return bool(progress.state)

    async def settle(self) -> None:
        """Prevent that a request without an answer still opens the gate, while it must not open.

        The network may deliver the request after an outage. The write also shows when the API server answers again.
        """
        is_due = self._is_sent or self._gate.unanswered_since is not None
        if (record := self._gate.record) is None or not is_due or time.monotonic() < self._open_after:
            return
        self._open_after = time.monotonic() + OPEN_AGAIN
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(OPEN_WITHIN):
                sent = AbandonedRecovery(id="opening", epoch=record.epoch, sent="")
                self._is_sent = not await self._gate.overtake(record, sent)

    async def request_pod(self, now: float) -> None:
        """Have the workload's own controller run a pod. The controller may have been scaled to zero while a pod of a shared pool was
        active, and nobody else scales it up while the gate is closed.
        """
        if now < self._next_asked <= now + ASK_AGAIN:  # a later time means that the clock was set back
            return
        self._next_asked = now + ASK_AGAIN
        try:
            async with asyncio.timeout(ASK_AGAIN):
                await self._fleet.replace([])
        except FAILURES as error:
            _logger.warning("no pod runs, and requesting one failed: %r", error)
