"""Judges the failed instance again while the first commit of its recovery is delayed.

A monitor that is cut off from the robot sees silence. If it is cut off from the API server too, its commit arrives later, when the
instance may have driven the robot the whole time.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from understudy.failover.interfaces import Instances
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.judge.unseen_restart import UnseenRestart
from understudy.monitor.observe.robot.health_observer import HealthObserver

OLD = 1.0
"""Seconds after which a decision is confirmed before a commit. A commit that is answered at the first try is earlier."""

PERIOD = 0.05
"""Seconds between two reads of the samples, so that they are complete when the instance is judged."""


class Reassessment:
    """Marks a recovery whose failed instance is healthy again, until the recovery has committed."""

    def __init__(self, fleet: Instances, observer: HealthObserver, unseen_restart: UnseenRestart) -> None:
        self._fleet, self._observer, self._unseen_restart = fleet, observer, unseen_restart

    @asynccontextmanager
    async def during(self, progress: Progress) -> AsyncIterator[None]:
        """Observe the failed instance until the recovery has fenced it."""
        nothing_failed = progress.planned or progress.switchover is not None or bool(progress.follows)
        if nothing_failed or progress.taken_over is not None or not progress.failed:
            yield
            return
        observing = asyncio.create_task(self._observe(progress, time.monotonic()))
        try:
            yield
        finally:
            observing.cancel()

    async def _observe(self, progress: Progress, decided: float) -> None:
        failed = progress.failed[0]
        await asyncio.sleep(OLD / 2)
        while not {"fenced", "committed"} & progress.moments.keys():
            self._observer.drain(self._fleet.of_workload(), failed.name)
            if (age := time.monotonic() - decided) >= OLD:
                progress.healthy_again = self._healthy_again(failed, age)
                progress.judged_at = asyncio.get_running_loop().time()
            await asyncio.sleep(PERIOD)

    def _healthy_again(self, failed: PodIdentity, age: float) -> bool:
        """Return whether a failed instance is healthy by what was received in the last ``age`` seconds.

        A lost pod stays failed, and so does one whose process is another since then: its state is lost.
        """
        pod, now = self._fleet.find(failed.uid), time.time()
        if pod is None or pod.leaving or not pod.running or self._observer.new_process(pod.name, since=now - age):
            return False
        if self._unseen_restart.onset(pod, now) is not None:
            return False
        return self._observer.verdict(now=now, since=now - age).state == "Healthy"
