"""Decides what happens now: one table of precedence for everything that can start an action and everything that can prevent it.

The monitor, the condition Protected and ``understudy explain`` all ask here. The functions are pure; times are unix seconds.
``docs/limits.md`` prints the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from understudy.failover.limits.state import ActiveLimit, LimitsInForce


class Trigger(StrEnum):
    """What can start an action."""

    HELD_RECOVERY = "HeldRecovery"
    """A recovery that fenced the failed instance and waits for a limit to end."""
    DECIDED_RECOVERY = "DecidedRecovery"
    """A recovery that was decided on and has not started."""
    INTERRUPTED_RECOVERY = "InterruptedRecovery"
    """The gate is closed, and its record names a recovery of another monitor that has not ended."""
    INITIAL_ACTIVATION = "InitialActivation"
    """The gate is closed and no recovery is in progress."""
    REFLEX_TAKEOVER = "ReflexTakeover"
    """The robot's own readers already follow a standby."""
    POD_LOST = "PodLost"
    """The pod of the active instance is deleted, gone or no longer running, or it restarted while no monitor watched."""
    DEPENDENCY_RECOVERED = "DependencyRecovered"
    """A workload in spec.dependsOn recovered, and this workload has to react."""
    HEALTH_FAILED = "HealthFailed"
    """The health tree fails."""
    UNSETTLED_SWITCHOVER = "UnsettledSwitchover"
    """The gate was switched as planned, and the result is not recorded yet."""
    SWITCHOVER_REQUESTED = "SwitchoverRequested"
    """An annotation or a node drain asks for a planned switchover."""
    DEGRADED = "Degraded"
    """The active instance is degraded and idle, and spec.degraded.reschedule asks for a hand-over."""


class Limit(StrEnum):
    """What can prevent an action."""

    STALE_SAMPLES = "StaleSamples"
    DEBOUNCE = "Debounce"
    UPSTREAM_FAILURE = "UpstreamFailure"
    PAUSE = "Pause"
    ROBOT_AWAY = "RobotAway"
    REQUIREMENT = "Requirement"
    WAIT_AFTER_RECOVERY = "WaitAfterRecovery"
    STORM = "Storm"
    CRASH_LOOP = "CrashLoop"
    BUDGET = "Budget"


@dataclass(frozen=True)
class Requirement:
    """A requirement of a trigger that is not met."""

    reason: Literal[
        "RecoveryUnderWay", "NoPodRunning", "NoPodReady", "StillDriven", "NotHealthy", "FirstStrategyUnavailable"
    ]
    words: str = ""


@dataclass(frozen=True)
class Occurrence:
    """A trigger that is present."""

    trigger: Trigger
    reason: str = ""
    """What happened, as a sentence without a full stop."""
    counts_from: float = 0.0
    """When the debounce of the policy ends."""
    upstream: ActiveLimit | None = None
    """A failure of a workload in spec.dependsOn that may have caused this one."""
    unmet: Requirement | None = None
    first_strategy: int | None = 0
    """Index of the strategy to start with; None if the instance of every strategy failed as soon as it was active."""
    retry_after: float = 0.0
    """Seconds until the first strategy is tried again, if ``first_strategy`` is None."""


@dataclass(frozen=True)
class Facts:
    """Everything that a decision depends on, at one instant."""

    now: float
    occurrences: tuple[Occurrence, ...] = ()
    limits: LimitsInForce = field(default_factory=LimitsInForce)
    standby_ready: bool = False
    """Whether a standby of this robot could take over, which takes no pod from other robots."""
    trusted_from: float = 0.0
    """Samples count from here on; later than ``now`` if the process was stalled and has not caught up."""


@dataclass(frozen=True)
class _Decision:
    """The fields that all decisions have."""

    reason: str
    """CamelCase, as in a condition."""
    message: str = ""
    deadline: float | None = None
    """When to decide again at the latest; None if only an event can change the decision."""
    trigger: Trigger | None = None


@dataclass(frozen=True)
class Wait(_Decision):
    """Nothing is due, or the trigger does not count yet. Nobody is informed."""


@dataclass(frozen=True)
class Defer(_Decision):
    """An action is due and a limit prevents it. The robot keeps what it has; users are informed."""


@dataclass(frozen=True)
class Hold(_Decision):
    """The failed instance is fenced, and nothing else is done until the limit ends."""


@dataclass(frozen=True)
class Activate(_Decision):
    """The gate opens for the first pod."""


@dataclass(frozen=True)
class Recover(_Decision):
    """The strategies of the policy are tried."""

    first_strategy: int = 0


@dataclass(frozen=True)
class SwitchOver(_Decision):
    """An understudy is prepared while the active instance runs, and the gate then switches."""


Decision = Wait | Defer | Hold | Activate | Recover | SwitchOver


@dataclass(frozen=True)
class TriggerRow:
    """A row of the table for a trigger: the decision if no limit prevents it."""

    trigger: Trigger
    decision: type[Activate] | type[Recover] | type[SwitchOver]
    yields: bool = False
    """Whether the next trigger is considered if a limit prevents this one."""


@dataclass(frozen=True)
class LimitRow:
    """A row of the table for a limit: the decision for these triggers while it is in force."""

    limit: Limit
    triggers: frozenset[Trigger]
    decision: type[Wait] | type[Defer] | type[Hold]
    reason: str
    message: str
    """Template: {words} are those of the limit, {left} the seconds until it ends."""
    consequence: str = ""
    """What a failure would lead to, for ``understudy explain`` and the condition Protected; empty if these do not mention the limit."""
    protected: bool = True
    """Whether the workload counts as Protected while the limit is in force. Limits that end within minutes do not change the condition:
    each change is a write, in a storm for a whole fleet.
    """


@dataclass(frozen=True)
class Prevention:
    """A limit in force that prevents the action of a trigger."""

    row: LimitRow
    limit: ActiveLimit
    decision: Wait | Defer | Hold
    """The decision if this were the only limit in force."""


FAILURES = frozenset({Trigger.POD_LOST, Trigger.HEALTH_FAILED})
PLANNED = frozenset({Trigger.DEPENDENCY_RECOVERED, Trigger.SWITCHOVER_REQUESTED, Trigger.DEGRADED})
"""Nothing has failed. The message of a wait has no figures, since each change of a message is a write to the API server."""

TRIGGERS: tuple[TriggerRow, ...] = (
    TriggerRow(Trigger.HELD_RECOVERY, Recover),
    TriggerRow(Trigger.DECIDED_RECOVERY, Recover),
    TriggerRow(Trigger.INTERRUPTED_RECOVERY, Recover),
    TriggerRow(Trigger.INITIAL_ACTIVATION, Activate),
    TriggerRow(Trigger.REFLEX_TAKEOVER, Recover),
    TriggerRow(Trigger.POD_LOST, Recover),
    TriggerRow(Trigger.DEPENDENCY_RECOVERED, Recover, yields=True),
    TriggerRow(Trigger.HEALTH_FAILED, Recover),
    TriggerRow(Trigger.UNSETTLED_SWITCHOVER, SwitchOver),
    TriggerRow(Trigger.SWITCHOVER_REQUESTED, SwitchOver, yields=True),
    TriggerRow(Trigger.DEGRADED, Recover),
)
"""The order in which triggers are considered."""

_WAITING, _PAUSED = "Waiting", "Paused"
_UNMET = Limit.REQUIREMENT
_AFTER = "limits.cooldown or a backoff requires a wait after the last recovery"

LIMITS: tuple[LimitRow, ...] = (
    LimitRow(
        Limit.STALE_SAMPLES,
        frozenset({Trigger.REFLEX_TAKEOVER, Trigger.HEALTH_FAILED}),
        Wait,
        "StaleSamples",
        "the monitor process was stalled and reads what arrived meanwhile",
    ),
    LimitRow(
        Limit.DEBOUNCE,
        frozenset({Trigger.HEALTH_FAILED}),
        Wait,
        "Debounce",
        "monitoring.debounce of the policy has not passed",
    ),
    LimitRow(Limit.UPSTREAM_FAILURE, frozenset({Trigger.HEALTH_FAILED}), Wait, "UpstreamFailure", "{words}"),
    LimitRow(
        Limit.PAUSE,
        FAILURES | PLANNED | {Trigger.INTERRUPTED_RECOVERY, Trigger.INITIAL_ACTIVATION},
        Defer,
        _PAUSED,
        "the monitor does nothing while the workload is {words}",
        consequence="the monitor would do nothing",
        protected=False,
    ),
    LimitRow(
        Limit.PAUSE,
        frozenset({Trigger.HELD_RECOVERY}),
        Hold,
        _PAUSED,
        "the monitor does nothing while the workload is {words}",
    ),
    LimitRow(
        Limit.ROBOT_AWAY,
        frozenset({Trigger.HEALTH_FAILED}),
        Defer,
        "RobotAway",
        "{words}",
        consequence="the monitor would do nothing until the robot is back",
    ),
    LimitRow(_UNMET, frozenset({Trigger.INTERRUPTED_RECOVERY}), Wait, "RecoveryUnderWay", "{words}"),
    LimitRow(
        _UNMET, frozenset({Trigger.INITIAL_ACTIVATION}), Wait, "NoPodRunning", "no pod of the workload is running"
    ),
    LimitRow(_UNMET, frozenset({Trigger.INITIAL_ACTIVATION}), Wait, "NoPodReady", "no pod of the workload is ready"),
    LimitRow(
        _UNMET,
        frozenset({Trigger.INITIAL_ACTIVATION}),
        Wait,
        "StillDriven",
        "an instance that was in control before may still reach the robot",
    ),
    LimitRow(_UNMET, frozenset({Trigger.SWITCHOVER_REQUESTED}), Defer, "NotHealthy", "{words}"),
    LimitRow(
        Limit.WAIT_AFTER_RECOVERY,
        FAILURES,
        Defer,
        _WAITING,
        "the next attempt is in {left} s",
        consequence="the monitor would do nothing for another {left} s",
    ),
    LimitRow(Limit.WAIT_AFTER_RECOVERY, PLANNED, Defer, _WAITING, _AFTER),
    LimitRow(
        Limit.BUDGET,
        frozenset({Trigger.DEGRADED}),
        Defer,
        "BudgetSpent",
        "limits.budget of the policy allows no further recovery for now (see the condition WithinBudget)",
    ),
    LimitRow(
        Limit.STORM,
        FAILURES | {Trigger.SWITCHOVER_REQUESTED},
        Defer,
        "Storm",
        "limits.stormGuard defers it because other workloads fail too: {words}",
        consequence="the monitor would use only a standby that is ready already",
    ),
    LimitRow(_UNMET, frozenset({Trigger.DEGRADED}), Defer, "FirstStrategyUnavailable", "{words}"),
    LimitRow(
        Limit.CRASH_LOOP,
        FAILURES | {Trigger.DEGRADED},
        Defer,
        "CrashLooping",
        "every strategy was tried, and each new instance failed as soon as it was active; the monitor tries the first strategy "
        "again in {left} s",
    ),
    LimitRow(
        Limit.BUDGET,
        FAILURES | {Trigger.DECIDED_RECOVERY, Trigger.HELD_RECOVERY},
        Hold,
        "BudgetSpent",
        "limits.budget of the policy is spent: {words}",
        consequence="the monitor would fence the failed instance and not replace it",
        protected=False,
    ),
)
"""The order in which limits are checked for a trigger. The first one in force decides."""


def decide(facts: Facts) -> Decision:
    """Return what happens now: the action of the first trigger that no limit prevents, or why nothing happens."""
    prevented: Decision | None = None
    for decision in considered(facts):
        if not isinstance(decision, Wait | Defer | Hold):
            return decision
        prevented = prevented or decision
    return prevented or Wait("NothingDue")


def considered(facts: Facts) -> Iterator[Decision]:
    """Return the decision for each trigger in order, up to the first that settles the matter."""
    present = {occurrence.trigger: occurrence for occurrence in facts.occurrences}
    for row in TRIGGERS:
        if (occurrence := present.get(row.trigger)) is None:
            continue
        prevention = next(in_force(facts, occurrence), None)
        if prevention is not None:
            yield prevention.decision
            if row.yields:
                continue
        elif row.decision is Recover:
            first = occurrence.first_strategy or 0
            yield Recover(row.trigger.value, occurrence.reason, trigger=row.trigger, first_strategy=first)
        else:
            yield row.decision(row.trigger.value, occurrence.reason, trigger=row.trigger)
        return


def in_force(facts: Facts, occurrence: Occurrence) -> Iterator[Prevention]:
    """Return every limit that prevents the action of a trigger now, in order."""
    for row in LIMITS:
        if occurrence.trigger in row.triggers and (found := _CHECKS[row.limit](facts, occurrence, row)) is not None:
            message = row.message.format(words=found.words, left=left(found, facts.now))
            yield Prevention(row, found, row.decision(row.reason, message, found.until, occurrence.trigger))


def left(found: ActiveLimit, now: float) -> str:
    """Return the seconds until a limit ends, rounded, as text."""
    return f"{max(0.0, found.until - now) if found.until is not None else 0.0:.0f}"


def _until(moment: float, now: float) -> ActiveLimit | None:
    return ActiveLimit(until=moment) if now < moment else None


def _unmet(occurrence: Occurrence, row: LimitRow) -> ActiveLimit | None:
    found = occurrence.unmet
    return ActiveLimit(found.words) if found is not None and found.reason == row.reason else None


def _crash_loop(facts: Facts, occurrence: Occurrence) -> ActiveLimit | None:
    return ActiveLimit(until=facts.now + occurrence.retry_after) if occurrence.first_strategy is None else None


_CHECKS: Mapping[Limit, Callable[[Facts, Occurrence, LimitRow], ActiveLimit | None]] = {
    Limit.STALE_SAMPLES: lambda facts, occurrence, row: _until(facts.trusted_from, facts.now),
    Limit.DEBOUNCE: lambda facts, occurrence, row: _until(occurrence.counts_from, facts.now),
    Limit.UPSTREAM_FAILURE: lambda facts, occurrence, row: occurrence.upstream,
    Limit.PAUSE: lambda facts, occurrence, row: facts.limits.pause,
    Limit.ROBOT_AWAY: lambda facts, occurrence, row: facts.limits.away,
    Limit.REQUIREMENT: lambda facts, occurrence, row: _unmet(occurrence, row),
    Limit.WAIT_AFTER_RECOVERY: lambda facts, occurrence, row: facts.limits.waiting,
    Limit.STORM: lambda facts, occurrence, row: None if facts.standby_ready else facts.limits.storm,
    Limit.CRASH_LOOP: lambda facts, occurrence, row: _crash_loop(facts, occurrence),
    Limit.BUDGET: lambda facts, occurrence, row: facts.limits.budget,
}
