"""Judges the failed instance again before the first commit of its recovery, if that is delayed.

A monitor that is cut off from the robot sees silence. If it is cut off from the API server too, its commit arrives later, when the
instance may have driven the robot the whole time. The same holds if that monitor ends before its commit, and the next one continues.

If the mux at the robot has switched to a standby, the failed instance is fenced even if it is healthy again, since the standby drives. But
the standby may fail too, and the mux may be back at the first instance before the commit is answered.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from understudy.failover.interfaces import Instances
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.gates.base import Proof
from understudy.monitor.judge.unseen_restart import UnseenRestart
from understudy.monitor.observe.robot.health_observer import HealthObserver

OLD = 1.0
"""Seconds after which a decision is confirmed before a commit. A commit that is answered at the first try is earlier."""

PERIOD = 0.05
"""Seconds between two reads of the samples, so that they are complete when the instance is judged."""


class Reassessment:
    """Marks a recovery whose failed instance is healthy again, until the recovery has committed."""

    def __init__(self, fleet: Instances, observer: HealthObserver, unseen_restart: UnseenRestart, proof: Proof) -> None:
        self._fleet, self._observer, self._unseen_restart, self._proof = fleet, observer, unseen_restart, proof

    @asynccontextmanager
    async def during(self, progress: Progress) -> AsyncIterator[None]:
        """Observe the failed instance until the recovery has fenced it."""
        if not fences_a_failure(progress) and progress.taken_over is None:
            yield
            return
        observing = asyncio.create_task(self._observe(progress, time.monotonic()))
        try:
            yield
        finally:
            observing.cancel()

    async def hears(self, failed: PodIdentity, within: float) -> bool:
        """Listen for ``within`` seconds. Returns whether an instance that an earlier monitor decided to fence is healthy."""
        began = time.monotonic()
        while (age := time.monotonic() - began) < within:
            self._observer.drain(self._fleet.of_workload(), failed.name)
            now = time.time()
            if self._lives(failed) and self._observer.verdict(now=now, since=now - age).state == "Healthy":
                return True
            await asyncio.sleep(PERIOD)
        return False

    async def _observe(self, progress: Progress, decided: float) -> None:
        failed = progress.failed[0]
        await asyncio.sleep(OLD / 2)
        while not {"fenced", "committed"} & progress.moments.keys():
            self._observer.drain(self._fleet.of_workload(), failed.name)
            age = time.monotonic() - decided
            if progress.taken_over is not None and not self._proof.is_back(failed.name):
                progress.healthy_again = False
            elif age >= OLD:
                progress.healthy_again = self._healthy_again(failed, age)
                progress.judged_at = asyncio.get_running_loop().time()
            await asyncio.sleep(PERIOD)

    def _healthy_again(self, failed: PodIdentity, age: float) -> bool:
        """Return whether a failed instance is healthy by what was received in the last ``age`` seconds.

        A lost pod stays failed, and so does one whose process is another since then: its state is lost.
        """
        now = time.time()
        if not self._lives(failed) or self._observer.new_process(failed.name, since=now - age):
            return False
        return self._observer.verdict(now=now, since=now - age).state == "Healthy"

    def _lives(self, failed: PodIdentity) -> bool:
        pod = self._fleet.find(failed.uid)
        if pod is None or pod.leaving or not pod.running:
            return False
        return self._unseen_restart.onset(pod, time.time()) is None


def fences_a_failure(progress: Progress) -> bool:
    """Whether a recovery begins by fencing an instance that failed, and by nothing else."""
    nothing_failed = progress.planned or progress.switchover is not None or bool(progress.follows)
    return not nothing_failed and progress.taken_over is None and bool(progress.failed)
