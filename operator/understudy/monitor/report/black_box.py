"""The black box: keeps the messages that the monitor received around a failure in a file, so that users can find its cause.

Until a failure, messages are bytes in a ring. During a recovery, the ring no longer drops old messages. Once the recovery is over and
the next instance has driven for a moment, a thread writes the file. Nothing here delays the monitor's loop, and nothing depends on it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from understudy.api.base import seconds
from understudy.api.kinds.recording_spec import BlackBox as Settings
from understudy.api.kinds.recording_spec import Recording, Recordings
from understudy.clock import CLOCK
from understudy.failover.progress import Progress, rfc3339
from understudy.kube.client import EVENTS, FAILURES, Object
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.report import mcap_writer
from understudy.monitor.report.mcap_writer import Content
from understudy.monitor.report.recording_archive import RecordingArchive, TooBig
from understudy.process.http_pages import JSON, Answer, Page
from understudy.ros.observe.sample_rings import SampleRing
from understudy.trees.core.snapshots import Shown

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.1
"""Seconds between two checks whether a node of the tree has changed."""

AGAIN = 1.0
"""Seconds after which the tree is recorded again although no node has changed."""

AFTER = 2.0
"""Seconds after the end of a recovery that are recorded too: the next instance's first commands, and Events, which are written late."""

NAMED = 8
"""Maximum number of pods whose Events are recorded."""

MCAP = "application/octet-stream"


class _Due(NamedTuple):
    """A recovery that is over."""

    at: float
    """When the recording is written (Unix seconds)."""
    progress: Progress


class BlackBox:
    """The black box of one workload. Does nothing if the policy has no ``blackBox``."""

    def __init__(
        self, view: ClusterView, observer: HealthObserver, notices: Notices, archive: RecordingArchive
    ) -> None:
        self._view, self._observer, self._notices, self._archive = view, observer, notices, archive
        self._settings: Settings | None = None
        self._ring: SampleRing | None = None
        self._present = ""
        """Id of the recovery that is under way; empty for none."""
        self._due: deque[_Due] = deque()
        self._states: Sequence[Shown] = ()
        self._next_trace = 0.0
        self._last = 0
        """Number of the last recorded recovery."""
        self._problem = ""
        self.pages: dict[str, Page] = {}
        """HTTP pages by path: the list of recordings, and each recording."""
        self._offer()

    # -- during a failover ------------------------------------------------------------------------------------------

    def begin(self, progress: Progress) -> None:
        """Note that a recovery begins. From now on, the ring keeps the messages that led to the failure."""
        if progress.planned or progress.follows or progress.switchover is not None or progress.id == self._present:
            return
        self._follow()
        if (ring := self._ring) is None:
            return
        if self._present and not self._due:  # the last recovery was not carried out
            ring.release()
        self._present = progress.id
        ring.hold(CLOCK.to_system(progress.moments.get("detected", CLOCK.now())))
        # The loop runs this while the failover waits for the API server.
        asyncio.get_running_loop().call_soon(self._trace)

    def end(self, progress: Progress) -> None:
        """Note that the recovery ended or was abandoned."""
        if progress.id != self._present:
            return
        self._present = ""
        if progress.result != "Running":
            self._due.append(_Due(time.time() + AFTER, progress))
        elif not self._due and self._ring is not None:
            self._ring.release()

    # -- in the background ------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Record the health tree, and write recordings when they are due, until cancelled. An error must not end the monitor."""
        while True:
            try:
                self._follow()
                self._trace_change()
                if self._due and time.time() >= self._due[0].at:
                    await self._write(self._due.popleft().progress)
            except Exception:
                _logger.exception("the black box")
                await asyncio.sleep(AGAIN)
            await asyncio.sleep(CHECK_PERIOD if self._ring is not None else AGAIN)

    def _follow(self) -> None:
        """Follow the policy's ``blackBox``."""
        policy = self._view.policy
        settings = policy.black_box if policy is not None else self._settings
        if settings is self._settings:
            return
        same = settings == self._settings
        self._settings = settings
        if not same:
            self._ring = SampleRing(seconds(settings.window), settings.memory_bytes) if settings is not None else None
            self._present, self._states = "", ()
            self._due.clear()
            self._observer.record(self._ring)

    def _trace_change(self) -> None:
        if self._ring is not None:
            now, states = time.monotonic(), self._observer.states
            if states != self._states or now >= self._next_trace:
                self._states, self._next_trace = states, now + AGAIN
                self._trace()

    def _trace(self) -> None:
        """Record the present health tree."""
        if (ring := self._ring) is None:
            return
        track, now, published = ring.track(mcap_writer.TREE, mcap_writer.TREE_TYPE), time.time(), self._notices.status
        if track.wanted:
            tree = self._observer.snapshot()
            status = {
                "health": published.health,
                "active": published.active,
                "epoch": published.gate.epoch,
                "tree": tree,
            }
            track.add(now, now, 0, mcap_writer.text(json.dumps({"time": round(now, 6), **status})))

    async def _write(self, progress: Progress) -> None:
        ring, settings = self._ring, self._settings
        if ring is None or settings is None:
            return
        recovery = self._notices.status.recovery(progress.id) or progress.to_recovery(self._notices.status.count)
        failed = CLOCK.to_system(progress.moments.get("detected", progress.cursor))
        since = failed - ring.seconds
        tracks = list(ring.taken(since))
        notes = {"leftOut": json.dumps(ring.left_out)} if ring.left_out else {}
        if ring.full is not None:
            notes["missedFrom"] = rfc3339(ring.full)
        left_out = dict(ring.left_out)
        if not self._present and not self._due:
            ring.release()
        if recovery.number == self._last:
            return  # the same failure continues: the recording of its start stays
        events, problem = await self._events(progress)
        if problem:
            notes["events"] = problem
        view = self._view
        offers = {track.topic: self._observer.offered(track.topic) for track in tracks}
        content = Content(view.namespace, view.workload, recovery, tracks, events, offers, since, notes)
        recording = Recording(
            id=progress.id,
            number=recovery.number,
            failed=rfc3339(failed),
            reason=recovery.reason,
            result=recovery.result,
            strategy=recovery.strategy,
            messages=0,
            left_out=left_out,
            size=0,
            sha256="",
        )
        try:
            kept = await asyncio.to_thread(
                self._archive.keep,
                recording,
                lambda file: mcap_writer.write(file, content),
                most=settings.max_recordings,
                most_bytes=settings.most_bytes,
            )
        except (OSError, TooBig) as error:
            self._report_problem(f"recovery {recovery.number} is not recorded: {error}")
            return
        finally:
            self._offer()
        self._problem, self._last = "", kept.number
        _logger.info("recovery %d is recorded: %d messages, %d bytes", kept.number, kept.messages, kept.size)

    async def _events(self, progress: Progress) -> tuple[list[Object], str]:
        """Return the Events of the workload and of its pods; and, if some are missing, the reason."""
        view = self._view
        pods = [pod["metadata"]["name"] for pod in view.all_pods()]
        pods = [*(pod.name for pod in progress.replaced), *(a.pod for a in progress.attempts), *pods]
        about = [
            ("RobotWorkload", view.workload),
            *(("Pod", pod) for pod in list(dict.fromkeys(filter(None, pods)))[:NAMED]),
        ]
        found: list[Object] = []
        try:
            for kind, name in about:
                fields = f"involvedObject.kind={kind},involvedObject.name={name}"
                found += (await view.client.list(EVENTS, view.namespace, fields=fields))["items"]
        except FAILURES as error:
            return found, f"not all could be read: {error}"
        return found, ""

    def _report_problem(self, text: str) -> None:
        """Log a problem, and report it in one Event until it is corrected."""
        _logger.error("%s", text)
        if not self._problem:
            self._problem = text
            self._notices.event("Warning", "NotRecorded", text)

    # -- pages ------------------------------------------------------------------------------------------------------

    def _offer(self) -> None:
        self.pages.clear()
        self.pages["/"] = self._listed
        for recording in self._archive.recordings:
            path = self._archive.path(recording)
            self.pages[f"/{path.name}"] = partial(_file, path)

    def _listed(self) -> Answer:
        left_out = self._ring.left_out if self._ring is not None else {}
        listed = Recordings(
            workload=self._view.workload,
            on=self._settings is not None,
            left_out=dict(left_out),
            recordings=list(self._archive.recordings),
        )
        return 200, json.dumps(listed.to_wire()) + "\n", JSON


def _file(path: Path) -> Answer:
    return 200, path, MCAP
