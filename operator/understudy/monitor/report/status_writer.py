"""Writes the reports of all stages: the status of the RobotWorkload, Events and metrics. Never on the path of a failover."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Sequence

from understudy.api.base import API_VERSION
from understudy.kube.client import FAILURES, WORKLOADS, ApiError, Client, Object
from understudy.kube.events import Recorder, reference
from understudy.kube.undeclared_fields import apply_declared, lacking
from understudy.kube.watched_collection import version_of
from understudy.monitor.notices import (
    EventRaised,
    GateCommitted,
    Notice,
    Notices,
    RecoveryStarted,
    RecoveryStopped,
    StatusAwaited,
    StatusChanged,
)
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.report import monitor_metrics

_logger = logging.getLogger(__name__)

MANAGER = "understudy-monitor"

QUIET = 0.25
"""Seconds that a change waits for other changes, so that a failover of milliseconds costs one write instead of three."""

UNDER_WAY = 3.0
"""Maximum seconds that a change during a recovery waits for its end, so that both take one write. The record at the gate shows at once
that a recovery is under way: the operator's storm guard and dependent workloads read that record. A recovery with a standby has a write
to spare (docs/scale.md), so its begin is written as soon as the first commit is made. It does not go before the commit.
"""

RETRY = 2.0  # seconds

ANSWERED_WITHIN = 4.0
"""Seconds that a write waits for its answer. Nothing else is written meanwhile, so recoveries that end then are listed only after it, and
never if this monitor ends first. Nobody waits for the status, so this is longer than for other requests: a busy API server may answer late.
"""

WATCH = 1.0
"""Seconds between two checks whether the status was overwritten."""

AGAIN = 10.0
"""Minimum seconds between two repairs of an overwritten status, so that two monitors of one workload do not write all the time."""


class StatusWriter:
    """Applies the status of one workload if it has changed: a healthy workload costs no writes."""

    def __init__(self, client: Client, view: ClusterView, recorder: Recorder, notices: Notices) -> None:
        self._client, self._view, self._recorder, self._notices = client, view, recorder, notices
        identity = {"apiVersion": API_VERSION, "kind": "RobotWorkload"}
        self._reference: Object = reference(view.object | identity) if view.object is not None else {}
        self._stream = notices.subscribe()
        self._changed = asyncio.Event()
        self._urgent = asyncio.Event()
        self._free = asyncio.Event()
        """Set while no recovery is under way, or if the status is urgent."""
        self._free.set()
        self._under_way = self._begin_is_urgent = False
        self._applied = ""
        self._written: Object = {}
        """The status that was applied last."""
        self._answer: Object | None = None
        """The object after that write; None if it is not known."""
        self._unknown: Sequence[str] = ()
        """Fields that the installed CRD lacks."""
        self._again_from = 0.0
        self._background: set[asyncio.Future[None]] = set()

    async def run(self) -> None:
        """Write reports until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._write())
            group.create_task(self._watch())
            while True:
                await self._stream.wait()
                for notice in self._stream.take():
                    self._take(notice)

    def _take(self, notice: Notice) -> None:
        monitor_metrics.count(notice)
        match notice:
            case StatusChanged():
                self._changed.set()
            case EventRaised():
                self._write_event(notice)
            case RecoveryStarted(status_soon=soon):
                self._under_way, self._begin_is_urgent = True, soon
                self._free.clear()
            case RecoveryStopped():
                self._under_way = self._begin_is_urgent = False
                self._free.set()
            case GateCommitted() if self._begin_is_urgent:
                self._begin_is_urgent = False
                self._urgent.set()
                self._free.set()
            case StatusAwaited():
                self._urgent.set()
                self._free.set()

    def _write_event(self, event: EventRaised) -> None:
        if self._reference:
            record = self._recorder.warning if event.kind == "Warning" else self._recorder.normal
            task = asyncio.ensure_future(record(self._reference, event.reason, event.message))
            self._background.add(task)
            task.add_done_callback(self._background.discard)

    def check(self, item: Object | None) -> None:
        """Write the status again if the watched object now has another one.

        The API server may carry out a write after its sender gave up: an earlier write of this monitor, or the last one of a monitor
        that died.
        """
        if item is None or self._answer is None or version_of(item) <= version_of(self._answer):
            return
        self._notices.merge(item)  # by another monitor of this workload, on a node that was lost
        if _share(item, self._written) == _share(self._answer, self._written) or time.monotonic() < self._again_from:
            return
        _logger.warning("the status of %s was overwritten: writing it again", self._view.workload)
        self._again_from = time.monotonic() + AGAIN
        self._applied, self._answer = "", None
        self._changed.set()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(WATCH)
            self.check(self._view.object)

    async def _write(self) -> None:
        while True:
            await self._changed.wait()
            await self._settled()
            self._changed.clear()
            self._urgent.clear()
            if self._under_way:
                self._free.clear()
            try:
                await self.flush()
            except FAILURES as error:
                if isinstance(error, ApiError) and error.not_found:
                    _logger.info("RobotWorkload %s is gone", self._view.workload)
                else:
                    _logger.warning("status not written: %s", error)
                self._changed.set()
                await asyncio.sleep(RETRY)

    async def _settled(self) -> None:
        """Wait for further changes: for QUIET seconds, and during a recovery for its end."""
        latest = time.monotonic() + UNDER_WAY
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(QUIET):
                    await self._urgent.wait()
            if self._urgent.is_set() or self._free.is_set() or time.monotonic() >= latest:
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(latest - time.monotonic()):
                    await self._free.wait()

    async def flush(self) -> None:
        """Apply the status now, unless it is the one that was applied last. Raises one of FAILURES."""
        place = {"name": self._view.workload, "namespace": self._view.namespace}
        status = self._notices.status.to_wire()
        body: Object = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": place, "status": status}
        text = json.dumps(body, sort_keys=True)
        if text == self._applied:
            return
        # The status applied before is no longer valid, even if no answer comes.
        self._applied, self._answer = "", None
        async with asyncio.timeout(ANSWERED_WITHIN):
            answer, unknown = await apply_declared(
                self._client, WORKLOADS, self._view.namespace, body, manager=MANAGER, subresource="status"
            )
        if unknown and unknown != self._unknown:
            _logger.warning("%s", lacking(WORKLOADS, unknown, "monitor"))
        self._unknown = unknown
        self._view.workloads.expect(answer)
        self._applied, self._written, self._answer = text, body["status"], answer


def _share(item: Object, written: Object) -> Object:
    """Return the part of an object's status that the monitor applied. The rest belongs to the operator."""
    status = item.get("status") or {}
    types = {c["type"] for c in written["conditions"]}
    found = {key: status[key] for key in written if key in status}
    return found | {"conditions": {c["type"]: c for c in status.get("conditions") or [] if c["type"] in types}}
