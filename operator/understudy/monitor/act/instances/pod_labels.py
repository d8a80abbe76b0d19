"""Keeps the labels of a workload's pods: the gate selects pods by these labels, and this monitor watches them by one of them.

New pods get them. A pod whose label somebody removed vanishes from the watch, as if it were gone, but no policy fences it any more. So the
API server is asked for each pod that vanishes. The operator restores labels too, but only while one of its replicas leads.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Sequence

from understudy.failover.interfaces import Instance
from understudy.kube.client import FAILURES
from understudy.monitor.act.objects.cluster import Cluster

AGAIN = 1.0
"""Seconds after which requests without success are repeated, although no pod has changed."""

ANSWER_WITHIN = 2.0
"""Seconds after which the requests for one pod count as not answered."""


class PodLabels:
    """Labels pods in the background: a slow API server must not delay a detection."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._revision: tuple[int, ...] | None = None
        self._next = -math.inf
        self._known: dict[str, Instance] = {}
        """By UID, the pods that were not being deleted when last seen. One that vanished stays until the API server has answered."""
        self._labelling: asyncio.Task[None] | None = None

    def follow(self) -> None:
        """Label the pods that lack a label, unless earlier ones are still being labelled. Returns at once."""
        now, revision = time.monotonic(), self._cluster.view.pods_revision
        if revision == self._revision and now < self._next:  # each evaluation asks
            return
        if self._labelling is not None and not self._labelling.done():
            return
        if self._revision is None:
            self._know_the_active_one()
        self._revision, self._next = revision, now + AGAIN
        instances = self._cluster.pods.of_workload()
        present = {one.uid for one in instances}
        vanished = [one for uid, one in self._known.items() if uid not in present]
        remaining = [one for one in instances if not one.terminating]
        self._known = {one.uid: one for one in (*vanished, *remaining)}
        self._labelling = asyncio.create_task(self._label(vanished, remaining))

    def _know_the_active_one(self) -> None:
        """Expect the pod that the gate names: it may have lost its label before this monitor started."""
        state = self._cluster.gate.state
        if state.active_uid:
            self._known[state.active_uid] = Instance(state.active, state.active_uid)

    async def _label(self, vanished: Sequence[Instance], instances: Sequence[Instance]) -> None:
        for instance in vanished:
            await self._cluster.pods.regain(instance.name, instance.uid)
            del self._known[instance.uid]
        for instance in instances:
            with contextlib.suppress(*FAILURES):
                async with asyncio.timeout(ANSWER_WITHIN):
                    await self._cluster.pods.label(instance)
