"""Labels the new pods of a workload: the gate selects pods by these labels."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence

from understudy.failover.interfaces import Instance
from understudy.kube.client import FAILURES
from understudy.monitor.act.objects.pod_control import PodControl


class PodLabels:
    """Labels pods in the background: a slow API server must not delay a detection."""

    def __init__(self, fleet: PodControl) -> None:
        self._fleet = fleet
        self._labelling: asyncio.Task[None] | None = None

    def follow(self, instances: Sequence[Instance]) -> None:
        """Label these instances, unless earlier ones are still being labelled. Returns at once."""
        if self._labelling is None or self._labelling.done():
            self._labelling = asyncio.create_task(self._label(instances))

    async def _label(self, instances: Sequence[Instance]) -> None:
        for instance in instances:
            if not instance.terminating:
                with contextlib.suppress(*FAILURES):
                    await self._fleet.label(instance)
