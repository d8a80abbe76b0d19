"""Determines which of the policy's situations the robot is in. The operator chooses strategies and standbys by it.

The situation is reported only when it changes. A policy without situations costs nothing.
"""

from __future__ import annotations

import logging
import time

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.situation_spec import SituationStatus
from understudy.failover import situation
from understudy.failover.progress import rfc3339
from understudy.failover.situation import Rule
from understudy.monitor.notices import Notices
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.trees.core.health_tree import Verdict

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.2
"""Seconds between two checks: preparing a standby takes seconds."""

HEARING = 10.0
"""Seconds that a new monitor needs to receive existing goals: until then, a missing goal does not end a situation."""


class SituationTracking:
    """Tracks the situation of one robot."""

    def __init__(self, observer: HealthObserver, notices: Notices) -> None:
        self._observer, self._notices = observer, notices
        self._situations = situation.Situations()
        self._started: float | None = None
        self._next = 0.0

    def update(self, policy: FailurePolicySpec, verdict: Verdict, *, now: float, since: float) -> None:
        """Determine the situation of the robot. Times are Unix seconds.

        While the active instance fails or starts, its goals may be without an owner for a moment: the situation stays
        as it is.
        """
        published = self._notices.status.situation
        if not policy.situations:
            if published is not None:
                self._report(None, "", now)
            return
        clock = time.monotonic()
        if clock < self._next:
            return
        self._next = clock + CHECK_PERIOD
        if self._started is None:
            self._started = clock
            if published is not None:
                self._situations.adopt(published.name, clock)
        rules = [Rule(one.name, seconds(one.after), seconds(one.clear_after)) for one in policy.situations]
        states = (
            self._observer.situations(self._notices.status.goals, now=now, since=since)
            if verdict.state == "Healthy"
            else {}
        )
        settled = clock - self._started >= HEARING
        found = self._situations.note(rules, {name: one.so for name, one in states.items() if one.so or settled}, clock)
        if found != (published.name if published is not None else None):
            self._report(found, states[found].reason if found is not None and found in states else "", now)

    def _report(self, name: str | None, reason: str, now: float) -> None:
        before = self._notices.status.situation
        if name is not None:
            self._notices.set_situation(SituationStatus(name=name, since=rfc3339(now), reason=reason))
            text = f"The robot is in the situation {name}: {reason or 'the previous one ended'}"
        else:
            self._notices.set_situation(None)
            text = f"The situation {before.name if before is not None else ''} ended"
        _logger.info("%s", text)
        self._notices.event("Normal", "SituationChanged", text)
