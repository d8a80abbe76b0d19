"""Publishes the workload's health for ROS tools: on ``/diagnostics``, and as snapshots of its health tree (docs/ros-tools.md).

Only if the workload asks for it, and not in the monitor's loop: a change is noted when it happens and published a moment later, so that
nothing is published during a switch. Messages without a reader are not made.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Mapping

from understudy.api.kinds.robot_workload import MonitorSettings
from understudy.monitor.notices import Notices, StatusChanged
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.report.diagnostics_status import Details, WorkloadState, status, workload_state
from understudy.ros.actions.diagnostics_topic import Diagnostics
from understudy.ros.actions.snapshot_streams import LEAST, Streams
from understudy.ros.runtime.interface_types import TypeNotInstalled
from understudy.trees.core.snapshot_behaviours import behaviours

_logger = logging.getLogger(__name__)

PERIOD = 1.0
"""Seconds between two statuses: the period of diagnostic_updater, and well within the 5 s of the aggregator."""

LATEST = 16
"""Maximum number of pending changes that are published one by one. If there are more, the oldest are left out."""


def namespace_of(workload: str) -> str:
    """Return the ROS namespace for the topics of a workload. Names in ROS have only letters, digits and underscores."""
    name = re.sub(r"[^A-Za-z0-9]", "_", workload)
    return f"/understudy/{name if name[0].isalpha() else f'_{name}'}"


class DiagnosticsPublisher:
    """Publishes the diagnostics of one workload."""

    def __init__(
        self,
        view: ClusterView,
        observer: HealthObserver,
        notices: Notices,
        kept: Callable[[], Mapping[str, float]] = dict,
    ) -> None:
        """``kept`` returns, by the name of each part of the kept state, when it was captured (Unix seconds)."""
        self._view, self._observer, self._notices, self._kept = view, observer, notices, kept
        self._settings = MonitorSettings()
        self._diagnostics: Diagnostics | None = None
        self._streams: Streams | None = None
        self._pending: deque[WorkloadState] = deque(maxlen=LATEST)
        self._level: int | None = None
        self._changed = False
        self._stream = notices.subscribe()
        self._next = 0.0
        self.problems: list[str] = []
        """Why something cannot be published, and how to correct it: one text per problem."""

    def _read(self) -> None:
        """Note the changes of the status since the last call."""
        for notice in self._stream.take():
            if isinstance(notice, StatusChanged) and self._diagnostics is not None:
                self._note(workload_state(notice.status, notice.at))

    def _note(self, now: WorkloadState) -> None:
        if now.level != self._level:
            self._level = now.level
            self._pending.append(now)
            self._changed = True
        elif self._pending and (now.active, now.epoch) == (self._pending[-1].active, self._pending[-1].epoch):
            # The reason is reported a moment after the state; a report after the switch belongs to the next state.
            self._pending[-1] = now._replace(at=self._pending[-1].at)

    async def run(self) -> None:
        """Publish until cancelled. An error here must not end the monitor."""
        try:
            while True:
                try:
                    await self._publish_status()
                except Exception:
                    _logger.exception("telling ROS tools")
                    await asyncio.sleep(PERIOD)
        finally:
            self._follow(MonitorSettings())

    async def _publish_status(self) -> None:
        self._read()
        spec = self._view.spec
        if spec is not None and spec.monitor != self._settings:
            self._follow(spec.monitor)
        self._diagnose()
        if self._streams is not None:
            await self._streams.serve()
            if self._streams.read():
                self._streams.show(behaviours(self._observer.snapshot(), self._view.workload))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PERIOD if self._streams is None else LEAST):
                while not self._changed:
                    await self._stream.wait()
                    self._read()

    def _follow(self, settings: MonitorSettings) -> None:
        """Create the publishers that the settings ask for, and close the others."""
        self._settings, self.problems = settings, []
        try:
            if settings.diagnostics and self._diagnostics is None:
                self._diagnostics = Diagnostics(self._observer.graph)
                self._level, self._next = None, 0.0
                self._note(workload_state(self._notices.status, time.time()))
            elif not settings.diagnostics and self._diagnostics is not None:
                self._diagnostics.close()
                self._diagnostics = None
                self._pending.clear()
        except TypeNotInstalled as error:
            self._problem("spec.monitor.diagnostics", error)
        try:
            if settings.snapshots and self._streams is None:
                self._streams = Streams(self._observer.graph, namespace_of(self._view.workload))
            elif not settings.snapshots and self._streams is not None:
                self._streams.close()
                self._streams = None
        except TypeNotInstalled as error:
            self._problem("spec.monitor.snapshots", error)

    def _problem(self, field: str, error: TypeNotInstalled) -> None:
        text = f"{field}: {error}"
        _logger.error("%s", text)
        self.problems.append(f"{text}.")
        self._notices.event("Warning", "TypeNotInstalled", text)

    def _diagnose(self) -> None:
        """Publish the changes since the last status, in order; if there are none, the present status every PERIOD seconds."""
        self._changed = False
        if self._diagnostics is None:
            return
        now = time.monotonic()
        if not self._pending and now < self._next:
            return
        self._next = now + PERIOD
        statuses = list(self._pending) or [workload_state(self._notices.status, time.time())]
        self._pending.clear()
        if not self._diagnostics.readers:
            return
        more = self._more()
        for each in statuses:
            found = status(self._view.namespace, self._view.workload, each, self._notices.status, more)
            self._diagnostics.publish(found, each.at)

    def _more(self) -> Details:
        spec, item = self._view.spec, self._view.object
        return Details(
            policy=spec.failure_policy_ref.name if spec is not None else "",
            standby=str(((item or {}).get("status") or {}).get("standby") or ""),
            kept=self._kept(),
            tree=self._observer.snapshot(),
        )
