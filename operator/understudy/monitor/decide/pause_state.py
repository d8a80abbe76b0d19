"""Tracks and reports whether a pause (``spec.pause``) is in force, in which the monitor takes no action."""

from __future__ import annotations

import logging

from understudy.api import names
from understudy.api.kinds.pause_spec import FENCE, Pause
from understudy.monitor.notices import Notices, PauseChanged
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

CONDITION = "Paused"

UNSEEN = Pause(
    owner="understudy fence", reason=f"{FENCE}known from the gate, since this monitor has not received the pause yet"
)
"""A fence that is known from the gate alone."""


class PauseState:
    """The pause of one workload. Times are Unix seconds."""

    def __init__(self, view: ClusterView, notices: Notices) -> None:
        self._view, self._notices = view, notices
        self._known: tuple[Pause | None, bool] = (None, False)
        self._resumed = ""
        """The value of the annotation ``resumed`` while the pause was in force. A later value was written when the pause was ended."""
        self._adopted = True
        """Whether this is still the condition of an earlier monitor, which has not been compared with the spec yet."""
        self._unseen = False
        """Whether a user has fenced the robot by a pause that this monitor does not know yet."""
        self.ended = 0.0
        """When the last pause ended (Unix seconds). Silence before that is not a failure."""

    @property
    def on(self) -> Pause | None:
        """The pause that was in force at the last update; None if there was none."""
        pause, in_force = self._known
        return pause if in_force else UNSEEN if self._unseen else None

    def update(self, now: float) -> None:
        """Check whether a pause is in force, and report a change."""
        spec = self._view.spec
        if spec is None:
            return
        current = spec.pause
        in_force = current is not None and current.in_force(now)
        record = self._view.gate_record
        self._unseen = not in_force and record is not None and self._view.fenced(record, now)
        if in_force or self._unseen:
            self.ended = now
        if in_force:
            self._resumed = self._annotation(names.RESUMED)
        before = self._known
        if (current, in_force) == before and not self._adopted:
            return
        self._known, self._adopted = (current, in_force), False
        self._notices.add(PauseChanged(in_force))
        if current is None:
            self._notices.withdraw(CONDITION)
        elif in_force:
            self._begin(current, is_new=before != (current, True))
        else:
            message = f"The pause is over, and spec.pause can be removed. The workload was {current.words}."
            self._notices.condition(CONDITION, "False", "Over", message)
        if before[1] and not in_force and before[0] is not None:
            pause, why = (
                before[0],
                f"spec.pause was removed{self._words()}" if current is None else "the pause reached its end",
            )
            _logger.warning("no longer %s: %s", pause.words, why)
            self._notices.event("Normal", "PauseEnded", f"No longer {pause.words}; {why}")

    def _words(self) -> str:
        """Return who ended the pause and why, for messages; empty if no reason was given."""
        found = self._annotation(names.RESUMED_FOR) if self._annotation(names.RESUMED) != self._resumed else ""
        return f" by {found}" if found else ""

    def _annotation(self, name: str) -> str:
        found: str = ((self._view.object or {}).get("metadata", {}).get("annotations") or {}).get(name, "")
        return found

    def _begin(self, pause: Pause, *, is_new: bool) -> None:
        way_out = f"understudy resume -n {self._view.namespace} {self._view.workload}"
        words = f"{pause.words[0].upper()}{pause.words[1:]}"
        text = f"{words}. The monitor watches the workload and takes no action. To end the pause, run: {way_out}."
        known = self._notices.status.find(CONDITION)
        again = known is not None and (known.status, known.message) == ("True", text)
        self._notices.condition(CONDITION, "True", "Maintenance", text)
        if is_new and not again:
            _logger.warning("%s", pause.words)
            self._notices.event("Normal", "Paused", text)
