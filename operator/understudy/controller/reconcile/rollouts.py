"""Replaces the monitors and discovery servers of a fleet in steps: during its replacement, a robot is not watched.

Such a Deployment stops its old pod before it starts a new one (Recreate). A change that concerns all of them, such as
an upgrade, would leave every robot of a fleet without its monitor at the same time. If the new monitors did not start,
the robots would stay without. So only a share is replaced at once, and the next ones follow when those are ready.
A workload without any ready pod before the change has nothing to lose, and does not wait.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Apply, Write
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import Store
from understudy.kube import apply
from understudy.kube.client import DEPLOYMENTS, PODS, WORKLOADS, Object

_logger = logging.getLogger(__name__)

PERCENT = 10
"""Percentage of the workloads whose monitors may be replaced at once (at least one).

The operator's options can change it.
"""

HOLD = 300.0
"""Seconds for which a workload that does not become ready keeps its place.

By then an alert has fired (UnderstudyMonitorNotReady). So a robot that was switched off meanwhile does not keep the fleet
from receiving a fix.
"""

CHECK_PERIOD = 3.0
"""Seconds until the workload whose turn is next checks again."""


@dataclass(frozen=True)
class _Step:
    """One workload whose pods are being replaced."""

    before: frozenset[str]
    """UIDs of its pods at the start."""
    fresh: int
    """Number of pods that are replaced."""
    until: float


class Rollouts:
    """The workloads whose monitors are being replaced, and those that wait for it."""

    def __init__(self, store: Store, *, percent: int = PERCENT, clock: Callable[[], float] = time.monotonic) -> None:
        self._store, self._percent, self._clock = store, percent, clock
        self._steps: dict[Key, _Step] = {}
        self._waiting: dict[Key, None] = {}

    def admitted(self, key: Key, writes: Sequence[Write]) -> tuple[list[Write], float | None]:
        """Return the writes that may be made now.

        If some must wait for the workload's turn, also return the seconds until the next check.
        """
        self._finish()
        late = [write for write in writes if isinstance(write, Apply) and self._replaces(key, write)]
        if not late or self._may(key, len(late)):
            self._waiting.pop(key, None)
            self._count()
            return list(writes), None
        self._waiting.setdefault(key)
        self._count()
        ahead = list(self._waiting).index(key)
        return [write for write in writes if write not in late], CHECK_PERIOD * (1 + ahead // self._places)

    def forget(self, key: Key) -> None:
        """Forget a deleted workload."""
        self._steps.pop(key, None)
        self._waiting.pop(key, None)
        self._count()

    @property
    def _places(self) -> int:
        return max(1, math.ceil(len(self._store.all(WORKLOADS)) * self._percent / 100))

    def _replaces(self, key: Key, write: Apply) -> bool:
        """Whether a write replaces existing pods."""
        if write.resource.plural != DEPLOYMENTS.plural:
            return False
        live = self._store.get(DEPLOYMENTS, key.namespace, kube_objects.name(write.body))
        if live is None or kube_objects.notes(live).get(apply.APPLIED) == apply.digest(write.body):
            return False  # a change by another client is repaired at once
        return bool(apply.differences(live["spec"]["template"], write.body["spec"]["template"]))

    def _may(self, key: Key, replaced: int) -> bool:
        if key in self._steps:
            return True
        pods = self._pods(key)
        if not any(kube_objects.ready(pod) for pod in pods):
            return True
        if len(self._steps) >= self._places:
            return False
        self._steps[key] = _Step(frozenset(map(kube_objects.uid, pods)), replaced, self._clock() + HOLD)
        return True

    def _finish(self) -> None:
        for key, step in list(self._steps.items()):
            pods = self._pods(key)
            fresh = [pod for pod in pods if kube_objects.uid(pod) not in step.before]
            done = len(fresh) >= step.fresh and all(kube_objects.ready(pod) for pod in pods)
            late = self._clock() >= step.until
            if late and not done:
                _logger.warning(
                    "%s/%s: its new monitor is not ready yet; the rollout continues with others",
                    key.namespace,
                    key.name,
                )
            if done or late or self._store.get(WORKLOADS, key.namespace, key.name) is None:
                del self._steps[key]

    def _pods(self, key: Key) -> Collection[Object]:
        found = self._store.labelled(PODS, key.namespace, names.MONITORED, key.name)
        return [pod for pod in found if kube_objects.alive(pod)]

    def _count(self) -> None:
        operator_metrics.ROLLOUTS.labels("waiting").set(len(self._waiting))
        operator_metrics.ROLLOUTS.labels("under_way").set(len(self._steps))
