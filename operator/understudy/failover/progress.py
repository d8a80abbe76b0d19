"""How far a recovery has come: all that a new monitor needs to finish it, and what ends up in the status.

It is written beside the gate with every commit and into the monitor's own journal in between, so that a monitor that is
killed at any step completes the recovery or safely does it again (DESIGN: the failover protocol).
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import Field, ValidationError

from understudy.api.base import Model
from understudy.api.kinds.robot_workload import Attempt, DependencyRecovery, Moments, Parts, Recovery
from understudy.api.kinds.state_spec import RestoredState
from understudy.api.kinds.switchover_spec import Kind
from understudy.api.protocol.kept_state import RestoreReport
from understudy.failover.pool_queue import Waiter

Part = Literal["detection", "cluster", "startup", "reinitialization"]


class PodIdentity(Model):
    """A pod, and not a later one of the same name."""

    name: str
    uid: str


class Progress(Model):
    """One recovery under way. Times are unix seconds."""

    id: str = Field(default_factory=lambda: uuid.uuid4().hex[:12])
    reason: str
    failed: list[PodIdentity] = Field(default_factory=list)
    """Pods that failed: the one that was in control, then every understudy that didn't verify."""
    target: PodIdentity | None = None
    taken_over: PodIdentity | None = None
    """The standby that the robot's own readers had fallen over to before anything was decided (the reflex)."""
    index: int = 0
    """The strategy being tried, an index into the policy's list."""
    attempts: list[Attempt] = Field(default_factory=list)
    epoch: int = 0
    resumed: bool = False
    planned: bool = False
    """Whether nothing failed: an instance that is degraded is replaced at an idle moment."""
    switchover: Kind | None = None
    """What for, where it is a planned switchover: its understudy was ready before the gate was touched."""
    request: str = ""
    """The annotation that asked for that, if one did."""
    former: PodIdentity | None = None
    """The instance that a planned switchover takes the robot from. It goes on running until the next one was seen to drive."""
    follows: list[DependencyRecovery] = Field(default_factory=list)
    """The recoveries of others after which this is done (``spec.dependsOn``); none where something failed here."""
    result: Literal["Running", "Recovered", "Failed"] = "Running"
    strategy: str = ""
    """The one being tried; in the end the one that recovered it, empty where none did."""
    cursor: float = 0.0
    """Up to when the time is accounted for."""
    parts: dict[Part, float] = Field(default_factory=dict)
    moments: dict[str, float] = Field(default_factory=dict)
    state: list[RestoredState] = Field(default_factory=list)
    """What became of the kept state in the present attempt."""
    waiting: Waiter | None = None
    """Its place among those that wait for a pod of a shared pool, while it waits: beside the gate others read it too."""

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
        """A recovery from a failure that has just been detected, or a hand-over that is planned."""
        progress = cls(reason=reason, failed=list(failed), planned=planned, cursor=last_healthy)
        progress.moments["last_healthy"] = last_healthy
        progress.moments["detected"] = detected
        progress.charge("detection", detected)
        return progress

    def charge(self, part: Part, until: float) -> None:
        """Account the time since the last call to a part of the recovery time (equation 1 of the paper).

        Where the reflex put a standby in control, nothing after that was waited for.
        """
        if part != "detection" and self.taken_over is not None and not self.has_failed(self.taken_over.uid):
            return
        self.parts[part] = self.parts.get(part, 0.0) + max(0.0, until - self.cursor)
        self.cursor = max(self.cursor, until)

    def note_first_output(self, first: float) -> None:
        """Note when the first output of the understudy was received at the gated readers.

        It proves that the gate was open. Where it came before the probe that was waited for, whose sender may have had to wait for
        a processor, the gate was enforced then at the latest.
        """
        moments = self.moments
        moments.setdefault("first_output", first)  # by the reflex it came before the commit
        routed = moments.get("routed")
        if routed is None or not moments.get("committing", routed) <= first < routed:
            return
        if moments.get("fenced") == routed:  # in one commit with it
            moments["fenced"] = first
        moments["routed"] = first
        if self.cursor == routed and "cluster" in self.parts:
            back = min(routed - first, self.parts["cluster"])
            self.parts["cluster"] -= back
            self.cursor -= back

    def release(self, now: float) -> None:
        """Go on after the policy's budget had held it. Nothing was tried in that time, so it belongs to none of the parts."""
        self.moments["released"] = self.cursor = now

    @property
    def began(self) -> float:
        """When something could be done about it, in unix seconds."""
        return self.moments.get("released", self.moments.get("detected", self.cursor))

    @property
    def occasion(self) -> Literal["FailureDetected", "Rescheduling", "FollowsDependency"]:
        """What it was begun for, as the condition Recovering has it while it is under way."""
        return "Rescheduling" if self.planned else "FollowsDependency" if self.follows else "FailureDetected"

    @property
    def held(self) -> bool:
        """Whether the policy's budget, or a pause, holds it: what failed is fenced, and nothing else is done."""
        return "held" in self.moments and "released" not in self.moments

    def has_failed(self, uid: str) -> bool:
        """Whether a pod is one of those that failed in this recovery."""
        return any(pod.uid == uid for pod in self.failed)

    @property
    def replaced(self) -> list[PodIdentity]:
        """The pods that don't drive the robot any more where this has come to its end: those that failed, and the former one."""
        handed = self.former is not None and self.result != "Failed" and not self.has_failed(self.former.uid)
        return [*self.failed, self.former] if handed and self.former is not None else list(self.failed)

    def fail_target(self) -> None:
        """Count the present target among the failed pods."""
        if self.target is not None:
            self.fail(self.target)
        self.target = None

    def fail(self, pod: PodIdentity) -> None:
        """Count a pod among the failed ones."""
        if not self.has_failed(pod.uid):
            self.failed.append(pod)

    def forget_attempt(self) -> None:
        """Drop the moments of an attempt that came to nothing; those of the failure stay."""
        self.moments = {name: time for name, time in self.moments.items() if name in _OF_THE_FAILURE}
        self.state = []
        self.waiting = None

    def note_state(self, report: RestoreReport) -> None:
        """Record what the instance that takes over was given, and what not. What was tried again counts as it ended last."""
        onset = self.moments.get("last_healthy", self.cursor)
        entries = [
            RestoredState(
                name=r.name,
                restored=True,
                age_seconds=round(max(0.0, onset - r.taken_at), 3),
                carried_metres=None if r.carried is None else round(r.carried, 3),
                message=r.note,
            )
            for r in report.restored
        ]
        entries += [RestoredState(name=n.name, restored=False, message=n.reason) for n in report.not_restored]
        known = {entry.name: entry for entry in self.state} | {entry.name: entry for entry in entries}
        self.state = list(known.values())

    def to_recovery(self, number: int) -> Recovery:
        """As it stands in ``status.recoveries``."""
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
            moments=Moments(**{name: rfc3339(time) for name, time in self.moments.items()}),
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
    """A recovery by its text beside a gate; None where there is none, or it can't be read."""
    try:
        return Progress.model_validate_json(recovery) if recovery else None
    except ValidationError:
        return None


LASTS = 10.0
"""Seconds after its beginning for which a recovery that only a gate tells of counts as under way, for whoever doesn't wait for its end by a
time of their own. A status follows its gate within three where its monitor lives (understudy.monitor.report.status_writer), and
the next monitor says so itself; of one that was given up the gate tells until that is said there (understudy.monitor.act.abandonment).
"""


@dataclass(frozen=True)
class Committed:
    """What a gate says, in short, of the recovery that committed to it last. Times are unix seconds."""

    id: str
    detected: float
    """When the failure was detected, or the hand-over began."""
    began: float
    """When something could be done about it: later than that where the policy's budget had held it."""
    planned: bool
    """Whether nothing had failed."""
    running: bool
    """Whether it had not come to its end."""

    @classmethod
    def of(cls, progress: Progress) -> Committed:
        """From the recovery as it stands beside the gate."""
        return cls(
            id=progress.id,
            detected=progress.moments.get("detected", 0.0),
            began=progress.began,
            planned=progress.planned or progress.switchover is not None,
            running=progress.result == "Running",
        )


Told = tuple[str, str | None]
"""A recovery that a status tells of: its id, and when it was detected (RFC 3339) where that is known."""


def told_in(recoveries: Iterable[Recovery]) -> list[Told]:
    """What ``status.recoveries`` tells of."""
    return [(recovery.id, recovery.moments.detected) for recovery in recoveries]


def under_way(committed: Committed | None, told: Iterable[Told], now: float | None = None) -> bool:
    """Whether the recovery beside a gate is under way, as far as the workload's status tells: the gate is there sooner.

    ``told`` are the recoveries in the status. With ``now`` (unix seconds) one counts for no longer than LASTS. Pure; by it go all who
    read a gate beside a status: the operator, those that depend on the workload, and people.
    """
    if committed is None or not committed.running:
        return False
    if now is not None and now >= committed.began + LASTS:
        return False
    for id_, detected in told:
        # Of several that failed only the last is in the status; an older one may stand beside the gate still.
        later = detected is not None and datetime.fromisoformat(detected).timestamp() >= committed.detected
        if id_ == committed.id or later:
            return False
    return True


def waiter(recovery: str) -> Waiter | None:
    """Who waits by a recovery as it stands beside a gate; None where it doesn't wait, or can't be read."""
    found = beside(recovery)
    return found.waiting if found is not None else None


def rfc3339(time: float) -> str:
    """Unix seconds as RFC 3339 with microseconds, in UTC."""
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
