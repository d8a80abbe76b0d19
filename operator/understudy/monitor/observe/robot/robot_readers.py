"""Who reads the outputs besides the monitor and the instances, and whether the gate can keep standbys from them.

The gate closes ports. A process of the robot that was started without its profile listens at others, where every instance that
executes is heard: nothing else would report that. ROS's graph says who reads, the middleware's discovery says where.
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
"""Seconds between checks of who reads. DDS is asked for those only that were not there at the last one."""

WITHIN = 5.0
"""Most seconds that an answer is waited for."""

AGAIN = 30.0
"""Seconds before it is asked again for readers that it has not reported."""

SETTLE = 10.0
"""Seconds for which a finding must last before it is reported: the address of an instance arrives a moment after its readers, and
a reading process may restart.
"""

CONDITION = "OutputsRead"


class RobotReaders:
    """Looks who reads the outputs of one workload."""

    def __init__(self, view: ClusterView, observer: HealthObserver, notices: Notices, address: str) -> None:
        """``address`` is that of this pod."""
        self._view, self._observer, self._notices, self._address = view, observer, notices, address
        self._places: dict[bytes, tuple[Locator, ...]] = {}
        self._asked: set[bytes] = set()
        self._again = 0.0
        self._judged: tuple[ConditionReport | None, float] = (None, 0.0)
        published = notices.status.find(CONDITION)
        self.ungated = published.message if published is not None and published.reason == UNGATED else ""
        """What is wrong with the readers that the gate does not reach; empty for nothing."""

    async def run(self) -> None:
        """Check until cancelled. What goes wrong here must not end the monitor."""
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
        """Check once, and report what has lasted for long enough."""
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
        """Ask DDS for the readers that are new, and now and then for those that it has not reported."""
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
