"""Measures CPU and memory of the active pod with the cluster's metrics API (metrics.k8s.io, as served by metrics-server).

The figures come from the kubelets. The monitor does not ask a kubelet itself: that needs a right to nodes, which would allow it to
run commands in every pod of the node (``nodes/proxy``) or to read the figures of all pods (``nodes/metrics``). The metrics API needs
only a right to the pods of the monitor's own namespace.
"""

from __future__ import annotations

import asyncio
import logging
import time

from understudy.api import names
from understudy.api.quantities import amount
from understudy.kube.client import NO_ANSWER, POD_METRICS, ApiError, Client, Object
from understudy.trees.core.observations import PodUsage

_logger = logging.getLogger(__name__)

PERIOD = 5.0
"""Seconds between requests. The metrics API usually updates its figures every 15 s."""

STALE = 90.0
"""Seconds without new figures after which the old ones are no longer used."""

_ABSENT = (
    "CPU and memory of pods are unknown: the cluster has no metrics API (metrics.k8s.io); install metrics-server, or leave "
    "cpu and memory out of the health tree."
)


class ResourceMeter:
    """Requests the figures of one pod while a leaf of the health tree needs them."""

    def __init__(self, client: Client, namespace: str, workload: str) -> None:
        self._client, self._namespace, self._workload = client, namespace, workload
        self._pod = ""
        self._asked = asyncio.Event()
        self._usage: PodUsage | None = None
        self._stamp = ""
        self._since = 0.0
        self._problem = ""

    def want(self, pod: str) -> None:
        """Measure this pod from now on; measure none if the name is empty."""
        if pod == self._pod:
            return
        self._pod, self._usage, self._stamp, self._problem = pod, None, "", ""
        self._since = time.monotonic()
        if pod:
            self._asked.set()
        else:
            self._asked.clear()

    @property
    def usage(self) -> PodUsage | None:
        """The last figures of the pod. None if there are none, or if they are too old."""
        return self._usage if time.monotonic() - self._since < STALE else None

    @property
    def problems(self) -> list[str]:
        """Why the figures are not available, and how to correct it."""
        if not self._pod or self.usage is not None:
            return []
        if self._problem:
            return [self._problem]
        late = time.monotonic() - self._since >= STALE
        lacking = (
            f"CPU and memory of {self._pod} are unknown: the metrics API has had no figures of it for {STALE:g} s."
        )
        return [f"{lacking} Look at metrics-server."] if late else []

    async def run(self) -> None:
        """Request figures until cancelled."""
        while True:
            await self._asked.wait()
            await self._ask()
            await asyncio.sleep(PERIOD)

    async def _ask(self) -> None:
        problem = ""
        try:
            for label in (names.WORKLOAD, names.CLAIMED_BY):
                self._take(await self._client.list(POD_METRICS, self._namespace, labels=f"{label}={self._workload}"))
        except ApiError as error:
            problem = _ABSENT if error.not_found else f"CPU and memory of pods are unknown: {error.message:.300}."
        except NO_ANSWER as error:
            problem = f"CPU and memory of pods are unknown: {error!r:.300}."
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            problem = (
                f"CPU and memory of pods are unknown: the metrics API returned an unexpected answer: {error!r:.300}."
            )
        if problem != self._problem:
            if problem:
                _logger.warning("%s", problem)
            self._problem = problem

    def _take(self, found: Object) -> None:
        for item in found["items"]:
            if item["metadata"]["name"] != self._pod or item["timestamp"] == self._stamp:
                continue
            used = [c["usage"] for c in item["containers"] if c["name"] != names.AGENT_CONTAINER]
            self._usage = PodUsage(*(float(sum(amount(u[key]) for u in used)) for key in ("cpu", "memory")))
            self._stamp, self._since = item["timestamp"], time.monotonic()
