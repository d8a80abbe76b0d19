"""Finds the readers of the outputs besides the monitor and the instances, and judges whether the gate can block standbys there.

The gate controls a range of ports. A process of the robot that was started without its DDS profile listens at other ports, where it
receives every executing instance: nothing else would report that. The ROS graph has the readers, and the middleware's discovery has
their ports.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time

from understudy.monitor.notices import ConditionReport, Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.reader_ports import UNGATED, Reading, judge
from understudy.ros.middleware import Locator
from understudy.ros.rmw import MIDDLEWARE

_logger = logging.getLogger(__name__)

PERIOD = 2.0
"""Seconds between two checks of the readers. Each asks DDS only for readers that are new since the last one."""

WITHIN = 5.0
"""Maximum seconds to wait for an answer of DDS."""

AGAIN = 30.0
"""Seconds until DDS is asked again for readers that it has not reported."""

SETTLE = 10.0
"""Seconds for which a result must last before it is reported: the address of an instance arrives a moment after its readers, and
a process that reads may restart.
"""

CONDITION = "OutputsRead"


class RobotReaders:
    """Checks the readers of one workload's outputs."""

    def __init__(self, view: ClusterView, observer: HealthObserver, notices: Notices, address: str) -> None:
        """``address`` is the IP of this pod."""
        self._view, self._observer, self._notices, self._address = view, observer, notices, address
        self._places: dict[bytes, tuple[Locator, ...]] = {}
        self._asked: set[bytes] = set()
        self._again = 0.0
        self._judged: tuple[ConditionReport | None, float] = (None, 0.0)
        published = notices.status.find(CONDITION)
        self.ungated = published.message if published is not None and published.reason == UNGATED else ""
        """The readers that the gate does not control, as a sentence; empty if there are none."""

    async def run(self) -> None:
        """Check until cancelled. An error here must not end the monitor."""
        while True:
            try:
                await self.check()
            except Exception:
                _logger.exception("checking who reads the outputs")
                self._notices.condition(
                    CONDITION, "Unknown", "ReadersUnknown", "Checking the readers failed: see the monitor's log."
                )
                await asyncio.sleep(AGAIN)
            await asyncio.sleep(PERIOD)

    async def check(self) -> None:
        """Check once, and report the result if it has lasted for SETTLE seconds."""
        spec = self._view.spec
        if spec is None or self._view.retired:
            return
        topics = list(dict.fromkeys(output.topic for output in spec.outputs if output.topic))
        if not topics:
            self.ungated = ""
            self._notices.withdraw(CONDITION)
            return
        readers = {topic: self._observer.graph.subscribers(topic) for topic in topics}
        await self._ask({end.gid for ends in readers.values() for end in ends})
        readings: list[Reading] = []
        unreported: set[str] = set()
        ours = {self._address, *self._observer.addresses.values()}
        for topic, ends in readers.items():
            for end in ends:
                places = self._places.get(end.gid)
                if places is None:
                    unreported.add(topic)
                elif places and not any(place.address in ours for place in places):
                    readings.append(Reading(topic, end.node, places))
        judged = judge(self._view.workload, topics, sorted(readings, key=str), unreported, spec.gate.robots)
        self._settle(judged, time.monotonic())

    async def _ask(self, there: set[bytes]) -> None:
        """Ask DDS for new readers, and every AGAIN seconds for those that it has not reported."""
        self._places = {gid: places for gid, places in self._places.items() if gid in there}
        self._asked &= there
        unknown, now = there - self._places.keys(), time.monotonic()
        if not unknown or (unknown <= self._asked and now < self._again):
            return
        self._asked |= unknown
        try:
            found = await MIDDLEWARE.reader_locators(unknown, self._address, os.environ, within=WITHIN)
        except (OSError, ValueError) as error:
            _logger.warning("discovery cannot be asked where the outputs are read: %s", error)
            found = {}
        self._places |= found
        self._again = time.monotonic() + AGAIN

    def _settle(self, judged: ConditionReport, now: float) -> None:
        before, since = self._judged
        if judged != before:
            self._judged = (judged, now)
        elif now - since >= SETTLE:
            self.ungated = judged[2] if judged[1] == UNGATED else ""
            self._notices.condition(CONDITION, *judged)
