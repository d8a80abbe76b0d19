"""The reports of a monitor's stages: an append-only stream of notices, and the status that follows from them.

The lowest layer of the monitor. Every stage may add notices and may read ``Notices.status``. The report stage subscribes to the
stream and writes later: adding a notice never waits, so it does not delay a failover.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal, Self

from understudy.api.conditions import MESSAGE_MOST, Condition, condition, merged
from understudy.api.kinds.robot_workload import (
    DependencyRecovery,
    GateStatus,
    Health,
    MonitorStatus,
    Recovery,
    RobotWorkloadStatus,
)
from understudy.api.kinds.situation_spec import SituationStatus
from understudy.api.kinds.state_spec import KeptStatus
from understudy.api.kinds.switchover_spec import SwitchoverStatus
from understudy.api.kinds.task_spec import TaskStatus
from understudy.api.plain_text import one_line
from understudy.clock import CLOCK
from understudy.failover.progress import ListedRecovery, Progress, listed_recoveries, rfc3339

ConditionReport = tuple[Literal["True", "False", "Unknown"], str, str]
"""Status, reason and message of a condition."""

RECOVERIES_KEPT = 10
"""Maximum number of recoveries that the status lists."""

NAMES_SHOWN = 3
"""Maximum number of names that a printer column shows."""

CONDITIONS = frozenset(
    {
        "Healthy",
        "DependencyFailed",
        "Monitored",
        "GateEnforced",
        "OutputsRead",
        "SoleDriver",
        "Recovering",
        "Degraded",
        "Reflex",
        "StateKept",
        "StateRestored",
        "TasksProxied",
        "Paused",
        "WithinBudget",
    }
)
"""Condition types that a monitor takes over from the monitor before it."""


@dataclass(frozen=True)
class PublishedStatus:
    """The monitor's part of the status of its RobotWorkload, as the report stage writes it."""

    active: str = ""
    health: Health = "Unknown"
    failing_since: float | None = None
    """When the last healthy output before the present failure was received (Unix seconds); None without a failure."""
    strategy: str = ""
    gate: GateStatus = field(default_factory=GateStatus)
    monitor: MonitorStatus | None = None
    by_type: Mapping[str, Condition] = field(default_factory=dict)
    recoveries: tuple[Recovery, ...] = ()
    """The last recoveries, newest first."""
    count: int = 0
    """Number of recoveries so far."""
    last_recovery_time: str | None = None
    spent_times: tuple[str, ...] = ()
    switchover: SwitchoverStatus | None = None
    situation: SituationStatus | None = None
    followed: tuple[DependencyRecovery, ...] = ()
    """Recoveries of dependencies that this workload has already reacted to."""
    kept: tuple[KeptStatus, ...] = ()
    task_statuses: tuple[TaskStatus, ...] = ()
    adopted: str = ""
    """The pod that was active when this monitor started, according to the monitor before it."""
    driven_epoch: int | None = None
    """The gate's epoch at which the active instance had driven already when this monitor started, according to the monitor before
    it; None if that is not known."""

    @classmethod
    def adopt(cls, item: Mapping[str, Any] | None) -> Self:
        """Return the part that a new monitor takes over from the status of the object; empty if there is no object."""
        found = RobotWorkloadStatus.model_validate((item or {}).get("status") or {})
        since = found.failing_since
        had_driven = bool(found.active) and found.health in ("Healthy", "Degraded", "Failed", "Recovering")
        return cls(
            failing_since=datetime.fromisoformat(since).timestamp() if since is not None else None,
            by_type={c.type: c for c in found.conditions or [] if c.type in CONDITIONS},
            recoveries=tuple(found.recoveries or ()),
            count=found.recovery_count or 0,
            last_recovery_time=found.last_recovery_time,
            spent_times=tuple(found.spent or ()),
            switchover=found.switchover,
            situation=found.situation,
            followed=tuple(found.dependencies or ()),
            # The operator makes a deleted gate again at this epoch, so it must not go back.
            gate=found.gate or GateStatus(),
            adopted=found.active or "",
            driven_epoch=found.gate.epoch if had_driven and found.gate is not None else None,
        )

    def with_recoveries_of(self, other: PublishedStatus) -> PublishedStatus:
        """Return the same with the recoveries that another monitor of this workload has recorded meanwhile.

        Those that this status no longer lists do not come back: older ones, and a failed one that a later one replaced.
        """

        def detected(recovery: Recovery) -> str:
            return recovery.moments.detected or ""

        oldest = detected(self.recoveries[-1]) if len(self.recoveries) >= RECOVERIES_KEPT else ""
        found = [one for one in other.recoveries if one.result == "Recovered" and detected(one) > oldest]
        missing = [one for one in found if one.id not in self.recorded]
        if not missing:
            return self
        both = sorted([*self.recoveries, *missing], key=detected, reverse=True)
        count = max(self.count + len(missing), other.count)
        numbered = [one.model_copy(update={"number": count - place}) for place, one in enumerate(both)]
        times = [time for time in (self.last_recovery_time, other.last_recovery_time) if time is not None]
        return replace(
            self,
            recoveries=tuple(numbered[:RECOVERIES_KEPT]),
            count=count,
            last_recovery_time=max(times, default=None),
            spent_times=tuple(sorted({*self.spent_times, *other.spent_times})),
        )

    @property
    def conditions(self) -> list[Condition]:
        """All conditions of the monitor."""
        return list(self.by_type.values())

    def find(self, type_: str) -> Condition | None:
        """Return the condition of a type; None if it was never set."""
        return self.by_type.get(type_)

    def reason(self, type_: str) -> str:
        """Return the reason of a condition; empty if it was never set."""
        found = self.by_type.get(type_)
        return found.reason if found else ""

    @property
    def last(self) -> Recovery | None:
        """The last recovery."""
        return self.recoveries[0] if self.recoveries else None

    def recovery(self, id_: str) -> Recovery | None:
        """Return a recovery by its id; None if the status does not list it."""
        return next((recovery for recovery in self.recoveries if recovery.id == id_), None)

    @property
    def listed(self) -> list[ListedRecovery]:
        """The recoveries in the form that the failover protocol compares with the record at the gate."""
        return listed_recoveries(self.recoveries)

    @property
    def recorded(self) -> set[str]:
        """Ids of the recoveries that the status lists."""
        return {r.id for r in self.recoveries}

    @property
    def spent(self) -> list[float]:
        """Start times of the recoveries that count against the budget (Unix seconds)."""
        return [datetime.fromisoformat(moment).timestamp() for moment in self.spent_times]

    @property
    def goals(self) -> list[str]:
        """Actions that have goals, according to the action proxy."""
        return [task.action for task in self.task_statuses if task.active]

    @property
    def planned(self) -> float | None:
        """When a degraded instance was last handed over (Unix seconds); None if no listed recovery is a hand-over."""
        handed = (r for r in self.recoveries if r.planned and r.switchover is None)
        found = (r.moments.detected for r in handed if r.moments.detected is not None)
        times = [datetime.fromisoformat(moment).timestamp() for moment in found]
        return max(times, default=None)

    def to_wire(self) -> dict[str, Any]:
        """Return the status in the form in which it is applied to the object."""
        return RobotWorkloadStatus(
            active=self.active,
            health=self.health,
            failing_since=rfc3339(self.failing_since) if self.failing_since is not None else None,
            strategy=self.strategy,
            gate=self.gate,
            monitor=self.monitor,
            recovery_count=self.count,
            last_recovery_time=self.last_recovery_time,
            spent=list(self.spent_times) or None,
            switchover=self.switchover,
            situation=self.situation,
            recoveries=list(self.recoveries),
            dependencies=list(self.followed) or None,
            kept=_in_short([entry.name for entry in self.kept if entry.taken_at is not None]) or None,
            state=list(self.kept) or None,
            tasks=list(self.task_statuses) or None,
            conditions=sorted(self.by_type.values(), key=lambda c: c.type),
        ).to_wire()


def _in_short(names: Sequence[str]) -> str:
    distinct = list(dict.fromkeys(names))
    more = f" and {len(distinct) - NAMES_SHOWN} more" if len(distinct) > NAMES_SHOWN else ""
    return ", ".join(distinct[:NAMES_SHOWN]) + more


@dataclass(frozen=True)
class Notice:
    """Something that a stage reports."""


@dataclass(frozen=True)
class StatusChanged(Notice):
    """The status of the workload is different now."""

    at: float
    """Unix seconds."""
    status: PublishedStatus


@dataclass(frozen=True)
class ConditionChanged(StatusChanged):
    """A condition was set."""

    condition: Condition


@dataclass(frozen=True)
class ConditionWithdrawn(StatusChanged):
    """A condition was removed, because its subject is gone."""

    type: str


@dataclass(frozen=True)
class RecoveryRecorded(StatusChanged):
    """A recovery or a planned switchover is over and is listed in the status."""

    recovery: Recovery


@dataclass(frozen=True)
class EventRaised(Notice):
    """An Event on the RobotWorkload."""

    kind: str
    """``Normal`` or ``Warning``."""
    reason: str
    message: str


@dataclass(frozen=True)
class RecoveryStarted(Notice):
    """A recovery has started."""

    status_soon: bool
    """Whether the status is written after the first commit too; otherwise after the end, which is one write less."""


@dataclass(frozen=True)
class RecoveryStopped(Notice):
    """The recovery is no longer under way."""


@dataclass(frozen=True)
class StatusAwaited(Notice):
    """Others wait for the status as it is now: other workloads, or people who may have to act."""


@dataclass(frozen=True)
class FailureDetected(Notice):
    """A failure was detected ``late`` seconds after its deadline."""

    late: float


@dataclass(frozen=True)
class RecoveryDeferred(Notice):
    """A limit defers the recovery of a failure."""

    reason: str


@dataclass(frozen=True)
class BecameDegraded(Notice):
    """The workload became degraded."""


@dataclass(frozen=True)
class PauseChanged(Notice):
    """``spec.pause`` came into force, or is no longer in force."""

    paused: bool


@dataclass(frozen=True)
class BudgetCounted(Notice):
    """Recoveries that ``limits.budget`` has left; None if the policy has no budget."""

    within: str
    left: int | None


@dataclass(frozen=True)
class StateKept(Notice):
    """The parts of kept state: when each was captured (Unix seconds; None for never), and its size in bytes."""

    parts: Mapping[str, tuple[float | None, int]]


@dataclass(frozen=True)
class PodAwaited(Notice):
    """The workload waited ``seconds`` for a pod of a shared pool."""

    pool: str
    result: str
    seconds: float


@dataclass(frozen=True)
class PodClaimed(Notice):
    """A claim of a pod of a shared pool took ``seconds``; its result is ``Won`` or ``Lost``."""

    result: str
    seconds: float


@dataclass(frozen=True)
class LeaksCounted(Notice):
    """Number of instances that reach the robot although the gate does not let them through."""

    count: int


@dataclass(frozen=True)
class GateCommitted(Notice):
    """The API server took ``seconds`` for a change of the gate."""

    seconds: float


GATHERING = 0.03
"""Seconds from a notice to its readers. By then, a switch to an executing standby and its reports are complete, and nobody reads while a
commit is made."""


class Subscription:
    """The notices that one reader has not read yet."""

    def __init__(self) -> None:
        self._pending: deque[Notice] = deque()
        self._added = asyncio.Event()

    def add(self, notice: Notice) -> None:
        """Append a notice."""
        self._pending.append(notice)
        self._added.set()

    def take(self) -> list[Notice]:
        """Return the unread notices, oldest first."""
        taken = list(self._pending)
        self._pending.clear()
        self._added.clear()
        return taken

    async def wait(self) -> None:
        """Return GATHERING seconds after the first unread notice."""
        await self._added.wait()
        await asyncio.sleep(GATHERING)


class Notices:
    """The stream of one monitor, and the status that follows from it."""

    def __init__(self, status: PublishedStatus | None = None, generation: int | None = None) -> None:
        """Start from the status that an earlier monitor left behind."""
        self._status = status or PublishedStatus()
        self._generation = generation
        self._subscriptions: list[Subscription] = []

    @property
    def status(self) -> PublishedStatus:
        """The status as of now, whether it is written yet or not."""
        return self._status

    def subscribe(self) -> Subscription:
        """Return a subscription to all notices from now on."""
        subscription = Subscription()
        self._subscriptions.append(subscription)
        return subscription

    def add(self, notice: Notice) -> None:
        """Append a notice that does not change the status."""
        for subscription in self._subscriptions:
            subscription.add(notice)

    def observe(self, generation: int | None) -> None:
        """Set the generation of the object's spec that conditions refer to from now on."""
        self._generation = generation

    def set(
        self,
        *,
        active: str | None = None,
        health: Health | None = None,
        strategy: str | None = None,
        gate: GateStatus | None = None,
        failing_since: float | None = None,
    ) -> None:
        """Set the given fields. A failure lasts until the workload is healthy: only the first ``failing_since`` counts.

        The gate's epoch does not go back, although somebody may lower it at the gate: the operator restores it from here.
        """
        old = self._status
        if gate is not None and gate.epoch < old.gate.epoch:
            gate = gate.model_copy(update={"epoch": old.gate.epoch})
        health = old.health if health is None else health
        since = old.failing_since if old.failing_since is not None else failing_since
        self._change(
            active=old.active if active is None else active,
            health=health,
            strategy=old.strategy if strategy is None else strategy,
            gate=old.gate if gate is None else gate,
            failing_since=None if health in ("Healthy", "Degraded") else since,
        )

    def condition(self, type_: str, status: str, reason: str, message: str = "") -> bool:
        """Set a condition. Returns whether its status or reason changed."""
        message = one_line(message, MESSAGE_MOST)
        old = self._status.by_type.get(type_)
        if old and (old.status, old.reason, old.message) == (status, reason, message):
            if self._generation is not None and old.observed_generation != self._generation:
                # The condition applies to the present spec too. kubectl wait ignores conditions of an earlier generation.
                self._put(old.model_copy(update={"observed_generation": self._generation}))
            return False
        fresh = condition(type_, status, reason, message, generation=self._generation)  # type: ignore[arg-type]
        self._put(merged([old] if old else [], [fresh])[0])
        return old is None or (old.status, old.reason) != (status, reason)

    def withdraw(self, type_: str) -> None:
        """Remove a condition whose subject is gone."""
        if type_ in self._status.by_type:
            left = {name: one for name, one in self._status.by_type.items() if name != type_}
            self._status = replace(self._status, by_type=left)
            self.add(ConditionWithdrawn(time.time(), self._status, type_))

    def event(self, kind: str, reason: str, message: str) -> None:
        """Raise an Event on the RobotWorkload."""
        self.add(EventRaised(kind, reason, message))

    def set_kept_state(self, kept: Sequence[KeptStatus]) -> None:
        """Set the status of kept state."""
        self._change(kept=tuple(kept))

    def set_tasks(self, tasks: Sequence[TaskStatus]) -> None:
        """Set the status of the proxied actions."""
        self._change(task_statuses=tuple(tasks))

    def set_monitor(self, monitor: MonitorStatus) -> None:
        """Set version and image of this monitor."""
        self._status = replace(self._status, monitor=monitor)
        self.add(StatusChanged(time.time(), self._status))

    def set_switchover(self, status: SwitchoverStatus) -> None:
        """Set the status of planned switchovers."""
        self._change(switchover=status)

    def set_situation(self, status: SituationStatus | None) -> None:
        """Set the situation of the robot; None for none."""
        self._change(situation=status)

    def set_followed(self, followed: Sequence[DependencyRecovery]) -> None:
        """Set the recoveries of dependencies that this workload has reacted to."""
        self._change(followed=tuple(followed))

    def set_spent(self, moments: Sequence[float]) -> None:
        """Set the start times of the recoveries that count against the budget (Unix seconds)."""
        self._change(spent_times=tuple(rfc3339(moment) for moment in moments))

    def request_write(self) -> None:
        """Ask for the status to be written at once, because others wait for it."""
        self.add(StatusAwaited())

    @contextlib.contextmanager
    def recovering(self, *, status_soon: bool) -> Iterator[None]:
        """Mark a recovery as under way. With ``status_soon``, the status reports that once its first commit is made."""
        self.add(RecoveryStarted(status_soon))
        try:
            yield
        finally:
            self.add(RecoveryStopped())

    def record(self, progress: Progress) -> Recovery:
        """Record a recovery that is over. If it failed like the one before it, it replaces that one."""
        old = self._status
        fresh, before = progress.to_recovery(0), old.last
        again = (
            before is not None
            and before.result == fresh.result == "Failed"
            and (before.from_pod, before.switchover) == (fresh.from_pod, fresh.switchover)
        )
        count = old.count if again else old.count + 1
        recovery = progress.to_recovery(count)
        verified = rfc3339(CLOCK.to_system(progress.moments.get("verified", progress.cursor)))[:19] + "Z"
        self._status = replace(
            old,
            recoveries=(recovery, *old.recoveries[again:])[:RECOVERIES_KEPT],
            count=count,
            last_recovery_time=verified if progress.result == "Recovered" else old.last_recovery_time,
        )
        self.add(RecoveryRecorded(time.time(), self._status, recovery))
        return recovery

    def merge(self, item: Mapping[str, Any]) -> None:
        """Take over the recoveries that another monitor of this workload has recorded in the status of its object."""
        merged = self._status.with_recoveries_of(PublishedStatus.adopt(item))
        if merged is not self._status:
            self._status = merged
            self.add(StatusChanged(time.time(), merged))

    def _put(self, fresh: Condition) -> None:
        self._status = replace(self._status, by_type={**self._status.by_type, fresh.type: fresh})
        self.add(ConditionChanged(time.time(), self._status, fresh))

    def _change(self, **fields: Any) -> None:
        if any(getattr(self._status, name) != value for name, value in fields.items()):
            self._status = replace(self._status, **fields)
            self.add(StatusChanged(time.time(), self._status))
