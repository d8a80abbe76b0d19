"""Finds pods of this workload whose label was removed or changed, from what they send to the robot.

Labels decide what the policies select and what is watched, so a pod without the workload's label is neither fenced nor known. Its address,
its UID and its owner still identify it; a pod that its ReplicaSet released because of its labels, by its agent.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Collection, Sequence

from understudy.api import names
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.interfaces import Instance
from understudy.kube.client import FAILURES, PODS, Object
from understudy.monitor.act.objects.pod_control import instance_of, is_stray
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.known_senders import host_at

_logger = logging.getLogger(__name__)

AGAIN = 5.0
"""Seconds between two lists of the namespace's pods, while a sender is unknown or a stray exists."""


def strays(
    pods: Sequence[Object], settings: WorkloadSettings, hosts: Collection[bytes], uids: Collection[str]
) -> list[Instance]:
    """Return the pods that are unknown senders and belong to this workload by their owner, whatever their labels say.

    ``hosts`` identify unknown senders of outputs by their GIDs, and ``uids`` those of packets that passed the gate.
    """
    return [
        instance
        for pod in pods
        if ((instance := instance_of(pod)).uid in uids or host_at(instance.ip) in hosts) and is_stray(pod, settings)
    ]


class StrayPods:
    """The strays of one workload."""

    def __init__(self, view: ClusterView) -> None:
        self._view = view
        self._hosts: set[bytes] = set()
        self._uids: set[str] = set()
        self._next = -math.inf
        self._listing: asyncio.Task[None] | None = None
        self.instances: Sequence[Instance] = ()
        """The strays, as of the last list."""

    def look(self, hosts: Collection[bytes], uids: Collection[str]) -> None:
        """Look for these unknown senders among the namespace's pods, in the background. Returns at once."""
        self._hosts |= set(hosts)
        self._uids |= set(uids)
        now = time.monotonic()
        if not (hosts or uids or self.instances) or now < self._next:
            return
        if self._listing is None or self._listing.done():
            self._next = now + AGAIN
            self._listing = asyncio.create_task(self._list())

    async def _list(self) -> None:
        if (settings := self._view.settings) is None:
            return
        try:
            pods = (await self._view.client.list(PODS, self._view.namespace))["items"]
        except FAILURES as error:
            _logger.warning("could not list the pods that may have sent to the robot: %r", error)
            return
        found = strays(pods, settings, self._hosts, self._uids)
        for instance in found:
            if instance.uid not in {one.uid for one in self.instances}:
                _logger.warning("%s reaches the robot without this workload's label %s", instance.name, names.WORKLOAD)
        self.instances = found
        # Senders that are no stray are forgotten: they are given again as long as they send.
        self._hosts = {host for one in found if (host := host_at(one.ip))}
        self._uids = {one.uid for one in found}

    def find(self, uid: str) -> Instance | None:
        """Return the stray with a UID; None if there is none."""
        return next((one for one in self.instances if one.uid == uid), None)
