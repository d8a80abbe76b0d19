"""Finds whether the monitor whose recovery is under way still exists.

The API server is asked, because this monitor watches no pods of monitors. A pod that is being deleted exists: its node may be lost, and its
process may live on.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time

from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import FAILURES, PODS, ApiError
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

ASK_PERIOD = 1.0
"""Minimum seconds between two requests."""

ANSWER_WITHIN = 1.0
"""Seconds after which a request counts as not answered."""


class OtherMonitors:
    """The pods of the other monitors of one workload, as far as recoveries name them."""

    def __init__(self, view: ClusterView) -> None:
        self._view = view
        self._gone: PodIdentity | None = None
        """The pod that does not exist, by the last answer that said so."""
        self._asked = -math.inf
        """When a request was sent last (monotonic seconds)."""
        self._asking: asyncio.Task[None] | None = None

    def may_continue(self, recovery: Progress) -> bool:
        """Return whether another monitor may still carry a recovery out. Asks in the background; returns at once."""
        pod = recovery.monitor
        if pod is None:
            return True
        if pod in (self._view.me, self._gone):
            return False
        now = time.monotonic()
        if now - self._asked >= ASK_PERIOD and (self._asking is None or self._asking.done()):
            self._asked, self._asking = now, asyncio.create_task(self._ask(pod))
        return True

    async def _ask(self, pod: PodIdentity) -> None:
        try:
            async with asyncio.timeout(ANSWER_WITHIN):
                found = await self._view.client.get(PODS, self._view.namespace, pod.name)
            exists = pod.uid in ("", found["metadata"]["uid"])
        except FAILURES as error:
            if not isinstance(error, ApiError) or error.status != 404:
                return
            exists = False
        if not exists:
            _logger.warning("monitor pod %s, which carried out a recovery, no longer exists", pod.name)
            self._gone = pod
