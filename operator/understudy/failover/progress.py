"""The progress of a recovery, from which a new monitor can finish it and which the status records.

A monitor writes it next to the gate with every commit, and into its journal in between. If a monitor is killed at any step, the next one
completes the recovery or safely repeats it.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import Field, ValidationError

from understudy.api.base import Model, ReportedText
from understudy.api.kinds.robot_workload import Attempt, DependencyRecovery, Moments, Parts, Recovery
from understudy.api.kinds.state_spec import RestoredState
from understudy.api.kinds.switchover_spec import Kind
from understudy.api.moments import UnixTime
from understudy.api.protocol.kept_state import RestoreReport
from understudy.clock import CLOCK
from understudy.failover.pool_queue import Waiter

Part = Literal["detection", "cluster", "startup", "reinitialization"]


class PodIdentity(Model):
    """A pod, as opposed to a later pod of the same name."""

    name: str
    uid: str


class Progress(Model):
    """One recovery in progress. Times are those of this process's clock (understudy.clock), and in a record those of the system's clock."""

    id: str = Field(default_factory=lambda: uuid.uuid4().hex[:12])
    reason: ReportedText
    failed: list[PodIdentity] = Field(default_factory=list)
    """Pods that failed: the one that was active, then every understudy that was not verified."""
    target: PodIdentity | None = None
    taken_over: PodIdentity | None = None
    """The standby that the robot's own readers already followed before the monitor decided (the reflex)."""
    index: int = 0
    """The strategy being tried, an index into the policy's list."""
    attempts: list[Attempt] = Field(default_factory=list)
    epoch: int = 0
    monitor: PodIdentity | None = None
    """The pod of the monitor that carries it out now; None in a record of an earlier version."""
    resumed: bool = False
    planned: bool = False
    """Whether nothing failed: a degraded instance is replaced while it is idle."""
    switchover: Kind | None = None
    """The kind of a planned switchover, whose understudy was ready before the gate changed; None for a recovery."""
    request: str = ""
    """The annotation that requested it, if there was one."""
    former: PodIdentity | None = None
    """The instance that was active before a planned switchover. It runs until outputs of the next one arrive."""
    follows: list[DependencyRecovery] = Field(default_factory=list)
    """The recoveries of other workloads that this one follows (``spec.dependsOn``); empty if something failed here."""
    result: Literal["Running", "Recovered", "Failed"] = "Running"
    strategy: str = ""
    """The strategy being tried; in the end the one that succeeded, empty if none did."""
    cursor: UnixTime = 0.0
    """The time up to which ``parts`` account for the recovery."""
    parts: dict[Part, float] = Field(default_factory=dict)
    moments: dict[str, UnixTime] = Field(default_factory=dict)
    state: list[RestoredState] = Field(default_factory=list)
    """Which kept state was restored in the present attempt."""
    given_restarts: int | None = None
    """How often the target's containers had restarted when it had its state, before the gate opened; None if none was restored."""
    waiting: Waiter | None = None
    """Its place in the queue for a pod of a shared pool, while it waits. Other workloads read it next to the gate."""
    open_at: int | None = None
    """The epoch at which the gate let the failed instance through when the recovery began; None if it did not, or is not known."""
    healthy_again: bool = Field(default=False, exclude=True)
    """Whether the instance whose failure began the recovery is healthy by what was received since then. Counts until the first commit."""
    drives_late: PodIdentity | None = Field(default=None, exclude=True)
    """An instance that drives by now, and did not within the time of its strategy. Counts while the gate admits it."""
    judged_at: float = Field(default=0.0, exclude=True)
    """When that was judged last, by the event loop's clock; 0 if it never was."""

    @classmethod
    def begin(
        cls,
        reason: str,
        *,
        last_healthy: float,
        detected: float,
        failed: Sequence[PodIdentity] = (),
        planned: bool = False,
    ) -> Progress:
        """Return a recovery from a failure that was just detected, or from a planned hand-over."""
        progress = cls(reason=reason, failed=list(failed), planned=planned, cursor=last_healthy)
        progress.moments["last_healthy"] = last_healthy
        progress.moments["detected"] = detected
        progress.charge("detection", detected)
        return progress

    @classmethod
    def of_record(cls, text: str) -> Progress:
        """Return the recovery in a record next to a gate or in a journal. Raises ValidationError."""
        return cls.model_validate_json(text).moved(-CLOCK.step())

    def record(self) -> str:
        """Return its record, with times of the system's clock as it is set now."""
        return self.moved(CLOCK.step()).model_dump_json()

    def moved(self, seconds: float) -> Progress:
        """Return the same with all times moved."""
        if not seconds:
            return self
        waiting = self.waiting.moved(seconds) if self.waiting is not None else None
        moments = {name: time + seconds for name, time in self.moments.items()}
        return self.model_copy(update={"moments": moments, "cursor": self.cursor + seconds, "waiting": waiting})

    def charge(self, part: Part, until: float) -> None:
        """Assign the time since the last call to a part of the recovery time (equation 1 of the paper).

        If the reflex activated a standby, the robot waited for nothing after that.
        """
        if part != "detection" and self.taken_over is not None and not self.has_failed(self.taken_over.uid):
            return
        self.parts[part] = self.parts.get(part, 0.0) + max(0.0, until - self.cursor)
        self.cursor = max(self.cursor, until)

    def note_first_output(self, first: float) -> None:
        """Record when the gated readers received the first output of the understudy.

        It proves that the gate was open. If it arrived before the probe, whose sender may have waited for a processor, the gate was
        enforced at that time at the latest.
        """
        moments = self.moments
        moments.setdefault("first_output", first)  # with the reflex it arrives before the commit
        routed = moments.get("routed")
        if routed is None or not moments.get("committing", routed) <= first < routed:
            return
        if moments.get("fenced") == routed:  # one commit fences and routes
            moments["fenced"] = first
        moments["routed"] = first
        if self.cursor == routed and "cluster" in self.parts:
            back = min(routed - first, self.parts["cluster"])
            self.parts["cluster"] -= back
            self.cursor -= back

    def release(self, now: float) -> None:
        """Continue after a limit held the recovery. Nothing was tried in that time, so no part accounts for it."""
        self.moments["released"] = self.cursor = now

    @property
    def began(self) -> float:
        """When it could start: after its detection, or after a limit released it."""
        return self.moments.get("released", self.moments.get("detected", self.cursor))

    @property
    def occasion(self) -> Literal["FailureDetected", "Rescheduling", "FollowsDependency"]:
        """The reason of the condition Recovering while it is in progress."""
        return "Rescheduling" if self.planned else "FollowsDependency" if self.follows else "FailureDetected"

    @property
    def held(self) -> bool:
        """Whether the policy's budget or a pause holds it: the failed pod is fenced, and nothing else is done."""
        return "held" in self.moments and "released" not in self.moments

    def another(self, recorded: Progress | None) -> Progress | None:
        """Return the recovery beside a gate if it is another one that has not ended; None otherwise."""
        is_another = recorded is not None and recorded.id != self.id and recorded.result == "Running"
        return recorded if is_another else None

    def has_failed(self, uid: str) -> bool:
        """Return whether a pod failed in this recovery."""
        return any(pod.uid == uid for pod in self.failed)

    @property
    def replaced(self) -> list[PodIdentity]:
        """The pods that no longer drive the robot after this recovery: those that failed, and the former one."""
        handed = self.former is not None and self.result != "Failed" and not self.has_failed(self.former.uid)
        return [*self.failed, self.former] if handed and self.former is not None else list(self.failed)

    def fail_target(self) -> None:
        """Add the present target to the failed pods."""
        if self.target is not None:
            self.fail(self.target)
        self.target = None

    def fail(self, pod: PodIdentity) -> None:
        """Add a pod to the failed ones."""
        if not self.has_failed(pod.uid):
            self.failed.append(pod)

    def forget_attempt(self) -> None:
        """Drop the moments of an attempt without success, and keep those of the failure."""
        self.moments = {name: time for name, time in self.moments.items() if name in _OF_THE_FAILURE}
        self.state, self.given_restarts = [], None
        self.waiting = None

    def resume(self, attempt: Progress) -> None:
        """Continue an attempt that was given up, from the progress that it had made."""
        self.failed, self.target = list(attempt.failed), attempt.target
        self.index, self.strategy, self.moments = attempt.index, attempt.strategy, dict(attempt.moments)
        self.state, self.given_restarts = list(attempt.state), attempt.given_restarts
        self.waiting = attempt.waiting

    def note_state(self, report: RestoreReport) -> None:
        """Record which state was restored to the instance that takes over, and which was not. The last attempt counts."""
        onset = self.moments.get("last_healthy", self.cursor)
        entries = [
            RestoredState(
                name=r.name,
                restored=True,
                age_seconds=round(max(0.0, onset - CLOCK.of_system(r.taken_at)), 3),
                carried_metres=None if r.carried is None else round(r.carried, 3),
                message=r.note,
            )
            for r in report.restored
        ]
        entries += [RestoredState(name=n.name, restored=False, message=n.reason) for n in report.not_restored]
        known = {entry.name: entry for entry in self.state} | {entry.name: entry for entry in entries}
        self.state = list(known.values())

    def to_recovery(self, number: int) -> Recovery:
        """Return its record for ``status.recoveries``."""
        parts = Parts(**{name: round(self.parts.get(name, 0.0), 6) for name in _PARTS})
        return Recovery(
            id=self.id,
            number=number,
            reason=self.reason,
            result=self.result,
            strategy=self.strategy,
            from_pod=next((pod.name for pod in (self.former, *self.failed) if pod is not None), ""),
            to_pod=self.target.name if self.target else "",
            epoch=self.epoch,
            recovery_seconds=round(sum(self.parts.values()), 6) if self.result == "Recovered" else None,
            parts=parts,
            moments=Moments(**{name: rfc3339(time) for name, time in self.moved(CLOCK.step()).moments.items()}),
            attempts=self.attempts,
            resumed=self.resumed,
            planned=self.planned,
            switchover=self.switchover,
            follows=self.follows or None,
            state=self.state,
        )


_PARTS: tuple[Part, ...] = ("detection", "cluster", "startup", "reinitialization")
_OF_THE_FAILURE = ("last_healthy", "detected", "held", "released")


def beside(recovery: str) -> Progress | None:
    """Return the recovery recorded next to a gate; None if there is none or it cannot be read."""
    try:
        return Progress.model_validate_json(recovery) if recovery else None
    except ValidationError:
        return None


LASTS = 10.0
"""Seconds after its start for which a recovery counts as in progress if only the gate records it. The status follows the gate within three
seconds while the monitor lives (understudy.monitor.report.status_writer), and a new monitor continues the recovery. An abandoned recovery
stays next to the gate until it is marked there (understudy.monitor.act.recovery.abandonment).
"""


@dataclass(frozen=True)
class Committed:
    """The recovery that committed to a gate last, in short. Times are unix seconds."""

    id: str
    detected: float
    """When the failure was detected or the hand-over began."""
    began: float
    """When it could start: later than ``detected`` if a limit held it."""
    planned: bool
    """Whether nothing had failed."""
    running: bool
    """Whether it has not ended."""

    @classmethod
    def of(cls, progress: Progress) -> Committed:
        """Return the summary of the record next to the gate."""
        return cls(
            id=progress.id,
            detected=progress.moments.get("detected", 0.0),
            began=progress.began,
            planned=progress.planned or progress.switchover is not None,
            running=progress.result == "Running",
        )


ListedRecovery = tuple[str, str | None]
"""A recovery in a status: its id, and when it was detected (RFC 3339), if that is known."""


def listed_recoveries(recoveries: Iterable[Recovery]) -> list[ListedRecovery]:
    """Return the recoveries in ``status.recoveries``."""
    return [(recovery.id, recovery.moments.detected) for recovery in recoveries]


def under_way(committed: Committed | None, listed: Iterable[ListedRecovery], now: float | None = None) -> bool:
    """Return whether the recovery next to a gate is in progress. The gate changes before the status does.

    ``listed`` are the recoveries in the status. With ``now`` (unix seconds) a recovery counts for no longer than LASTS. The operator,
    dependent workloads and the command line use this.
    """
    if committed is None or not committed.running:
        return False
    if now is not None and now >= committed.began + LASTS:
        return False
    for id_, detected in listed:
        # Of several failed recoveries the status has only the last; an older one may still be next to the gate.
        later = detected is not None and datetime.fromisoformat(detected).timestamp() >= committed.detected
        if id_ == committed.id or later:
            return False
    return True


def waiter(recovery: str) -> Waiter | None:
    """Return who waits for a pod, from the record next to a gate; None if nobody waits or it cannot be read."""
    found = beside(recovery)
    return found.waiting if found is not None else None


def rfc3339(time: float) -> str:
    """Return unix seconds as RFC 3339 with microseconds, in UTC."""
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
