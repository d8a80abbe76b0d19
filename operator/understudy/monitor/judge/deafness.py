"""Notices that DDS discovery has left this process deaf for the active instance, and ends the process.

While a discovery server comes back after a restart, the announcement of a writer can be lost for one participant for good. Then the robot
and every other process receive the instance, and this one never does: it would fail a healthy instance. A process that starts again
discovers everything. What must last is stored before each step, so this costs no more than any other restart of the container.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, replace
from pathlib import Path

from understudy.failover.interfaces import Gate, Instance, Instances
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)

PERIOD = 1.0
"""Seconds between two looks."""

LOOKS = 10
"""Looks in a row without an endpoint of the instance after which this process is deaf for it. They are counted, and the time is not
measured, because discovery stands still too while the process is stalled."""

TIME_TO_REPORT = 1.0
"""Seconds for the Event before the process ends."""


class Deaf(Exception):
    """This process must start again to hear the active instance. The text says why."""


@dataclass(frozen=True)
class Search:
    """The search for the endpoints of one instance."""

    uid: str = ""
    missed: int = 0
    """Looks in a row that found none although the instance has some."""
    over: bool = False
    """Whether an endpoint was found, or was missed for long enough."""

    def after(self, uid: str, found: bool | None) -> Search:
        """Return the search after a look at the active instance. ``found`` is None if that look could not tell."""
        if uid != self.uid:
            return Search(uid).after(uid, found)
        if self.over:
            return self
        missed = self.missed + 1 if found is False else 0
        return replace(self, missed=missed, over=bool(found) or missed >= LOOKS)

    @property
    def is_deaf(self) -> bool:
        """Whether this process is deaf for the instance."""
        return self.missed >= LOOKS


class EndedFor:
    """The instances for which this process has ended itself, in a file that survives a restart of its container."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def add(self, uid: str) -> bool:
        """Store a UID. Returns False if it is stored already or cannot be: without it, the process could end again and again."""
        try:
            known = self._path.read_text().split() if self._path.exists() else []
            if uid in known:
                return False
            replace_file(self._path, "".join(f"{one}\n" for one in [*known, uid]))
        except (OSError, ValueError) as error:
            _logger.warning("the monitor is deaf for the active instance and does not end, because: %s", error)
            return False
        return True


class DeafnessWatch:
    """Looks for the active instance's endpoints until they are discovered, also during a recovery."""

    def __init__(
        self,
        pods: Instances,
        gate: Gate,
        agents: AgentConnections,
        observer: HealthObserver,
        ended_for: EndedFor,
        notices: Notices,
    ) -> None:
        self._pods, self._gate, self._agents, self._observer = pods, gate, agents, observer
        self._ended_for, self._notices = ended_for, notices
        self._search = Search()

    async def run(self) -> None:
        """Look once a second until cancelled. Raises Deaf if this process must end."""
        while True:
            await asyncio.sleep(PERIOD)
            if (deaf := self.look()) is not None:
                await asyncio.sleep(TIME_TO_REPORT)
                raise deaf

    def look(self) -> Deaf | None:
        """Look once. Returns why this process must end; None if it need not. That is at most once for each instance.

        An agent reports its instance as ready only while the pod has an endpoint of an output and the health tree succeeds on what the
        agent itself receives.
        """
        active = self._pods.find(self._gate.state.active_uid)
        uid = active.uid if active is not None else ""
        if uid == self._search.uid and self._search.over:
            return None
        self._search = self._search.after(uid, self._found(active))
        if active is None or not self._search.is_deaf or not self._ended_for.add(uid):
            return None
        text = (
            f"The agent of {active.name} reports healthy outputs, but DDS discovery has reported none of them to this monitor for "
            f"{LOOKS * PERIOD:.0f} s, or the monitor has received nothing from anybody, or nothing on a topic that the robot publishes. "
            "The monitor ends, so that its container starts again and joins the ROS graph as a new participant."
        )
        self._notices.event("Warning", "MonitorDeaf", text)
        return Deaf(text)

    def _found(self, active: Instance | None) -> bool | None:
        """Return whether an endpoint of the instance is discovered, and this monitor hears the robot; None if that cannot be known yet.

        Without the API server, another process could not start, so this one goes on.
        """
        if active is None or not active.usable or self._gate.unanswered_since is not None:
            return None
        if not self._agents.is_ready(active)[0]:
            return None
        found = self._observer.discovered(active)
        if found and not self._observer.hears_nobody and not self._observer.unheard:
            return None if self._observer.awaited else True
        return None if found is None else False
