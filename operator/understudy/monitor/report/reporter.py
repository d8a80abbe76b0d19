"""What the monitor says: its part of the RobotWorkload's status, Events, metrics. Never on the path of a failover."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime

import aiohttp

from understudy.api.base import API_VERSION
from understudy.api.conditions import Condition, condition, merged
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
from understudy.failover.progress import Progress, Told, rfc3339, told_in
from understudy.kube.client import WORKLOADS, ApiError, Client, Object
from understudy.kube.events import Recorder
from understudy.kube.undeclared_fields import apply_declared, lacking
from understudy.kube.watched_collection import version_of
from understudy.monitor.report import monitor_metrics

_logger = logging.getLogger(__name__)

MANAGER = "understudy-monitor"
KEPT = 10
"""Recoveries in the status."""

NAMED = 3
"""Names that a column shows."""

QUIET = 0.25
"""Seconds that a change waits for others, so that a failover in milliseconds costs one write and not three."""

UNDER_WAY = 3.0
"""Seconds that what changes in a recovery waits for its end, so that it's told in one write. The record beside the gate tells at once that
there is one: the operator's storm guard and whoever depends on this workload go by that.
"""

RETRY = 2.0  # seconds

AGAIN = 10.0
"""Seconds before what was written over is said again once more: of two monitors of one workload neither keeps the other writing."""


class Reporter:
    """Collects what is to be said and applies it when it has changed: a healthy workload costs no writes."""

    def __init__(self, client: Client, namespace: str, workload: str, recorder: Recorder) -> None:
        self._client, self._namespace, self._workload = client, namespace, workload
        self._recorder = recorder
        self.on_change: Callable[[], None] = lambda: None
        """Called at once when the health, or a condition, is another; also in the midst of a failover."""
        self._changed = asyncio.Event()
        self._urgent = asyncio.Event()
        self._free = asyncio.Event()
        """Nothing is under way for whose end a write waits."""
        self._free.set()
        self._applied = ""
        self._said: Object = {}
        """The status that was applied last."""
        self._answer: Object | None = None
        """The object as that made it; None while nobody knows."""
        self._unknown: Sequence[str] = ()
        """What the definition doesn't know of it."""
        self._again_from = 0.0
        self._conditions: dict[str, Condition] = {}
        self._kept: list[KeptStatus] = []
        self._tasks: list[TaskStatus] = []
        self._recoveries: list[Recovery] = []
        self.followed: list[DependencyRecovery] = []
        """The recoveries of others after which was done what is done then."""
        self._count = 0
        self._last_time: str | None = None
        self._spent: list[str] = []
        self.switchover: SwitchoverStatus | None = None
        """What was said last of planned switchovers."""
        self.situation: SituationStatus | None = None
        """The situation of the policy that the robot is in, as it was said last."""
        self.adopted = ""
        """The pod that was in control when this monitor began, by what an earlier one had said."""
        self.active = ""
        self.health: Health = "Unknown"
        self.failing_since: float | None = None
        """The last healthy output before the failure that isn't over (unix seconds)."""
        self.strategy = ""
        self.gate = GateStatus()
        self.monitor: MonitorStatus | None = None
        """Who says all this."""
        self.generation: int | None = None
        self.reference: Object = {}

    def adopt(self, item: Object) -> None:
        """Take over from the object's status what an earlier monitor had recorded."""
        status = RobotWorkloadStatus.model_validate(item.get("status") or {})
        self._recoveries = list(status.recoveries or [])
        self._count = status.recovery_count or 0
        self._last_time = status.last_recovery_time
        self._spent = list(status.spent or [])
        self.switchover = status.switchover
        self.situation = status.situation
        self.adopted = status.active or ""
        self.followed = list(status.dependencies or [])
        if status.failing_since is not None:
            self.failing_since = datetime.fromisoformat(status.failing_since).timestamp()
        ours = {
            "Healthy",
            "DependencyFailed",
            "Monitored",
            "GateEnforced",
            "OutputsRead",
            "Recovering",
            "Degraded",
            "Reflex",
            "StateKept",
            "StateRestored",
            "TasksProxied",
            "Paused",
            "WithinBudget",
        }
        self._conditions = {c.type: c for c in status.conditions or [] if c.type in ours}
        self.reference = {
            "apiVersion": API_VERSION,
            "kind": "RobotWorkload",
            "metadata": {
                "name": item["metadata"]["name"],
                "namespace": item["metadata"]["namespace"],
                "uid": item["metadata"]["uid"],
                "resourceVersion": item["metadata"].get("resourceVersion", ""),
            },
        }

    @property
    def conditions(self) -> list[Condition]:
        """What was said of each type."""
        return list(self._conditions.values())

    @property
    def count(self) -> int:
        """How many recoveries there were."""
        return self._count

    @property
    def last(self) -> Recovery | None:
        """The last recovery."""
        return self._recoveries[0] if self._recoveries else None

    def recovery(self, id_: str) -> Recovery | None:
        """A recovery by its id; None where the status has it no longer, or never had."""
        return next((recovery for recovery in self._recoveries if recovery.id == id_), None)

    @property
    def told(self) -> list[Told]:
        """What the status tells of recoveries."""
        return told_in(self._recoveries)

    @property
    def recorded(self) -> set[str]:
        """Ids of the recoveries in the status."""
        return {r.id for r in self._recoveries}

    def set(
        self,
        *,
        active: str | None = None,
        health: Health | None = None,
        strategy: str | None = None,
        gate: GateStatus | None = None,
        failing_since: float | None = None,
    ) -> None:
        """Say what is so now; what is not given stays. A failure lasts until it is healthy: its beginning is said once."""
        before = (self.active, self.health, self.strategy, self.gate, self.failing_since)
        self.active = self.active if active is None else active
        self.health = self.health if health is None else health
        self.strategy = self.strategy if strategy is None else strategy
        self.gate = self.gate if gate is None else gate
        if self.health in ("Healthy", "Degraded"):
            self.failing_since = None
        elif self.failing_since is None:
            self.failing_since = failing_since
        if (self.active, self.health, self.strategy, self.gate, self.failing_since) != before:
            monitor_metrics.health(self.health)
            monitor_metrics.epoch(self.gate.epoch)
            self._changed.set()
            self.on_change()

    def condition(self, type_: str, status: str, reason: str, message: str = "") -> bool:
        """Say a condition; whether its status or reason changed."""
        old = self._conditions.get(type_)
        if old and (old.status, old.reason, old.message) == (status, reason, message):
            if self.generation is not None and old.observed_generation != self.generation:
                # It is so by the present spec too. kubectl wait takes nothing that is about an earlier one.
                self._conditions[type_] = old.model_copy(update={"observed_generation": self.generation})
                self._changed.set()
            return False
        fresh = condition(type_, status, reason, message, generation=self.generation)  # type: ignore[arg-type]
        self._conditions[type_] = merged([old] if old else [], [fresh])[0]
        self._changed.set()
        self.on_change()
        return old is None or (old.status, old.reason) != (status, reason)

    def find(self, type_: str) -> Condition | None:
        """A condition as it was said last; None where it never was."""
        return self._conditions.get(type_)

    def reason(self, type_: str) -> str:
        """The reason of a condition as it was said last; empty where it never was."""
        found = self._conditions.get(type_)
        return found.reason if found else ""

    def keep(self, kept: Sequence[KeptStatus]) -> None:
        """Say what is kept."""
        if self._kept != list(kept):
            self._kept = list(kept)
            self._changed.set()

    def tasks(self, tasks: Sequence[TaskStatus]) -> None:
        """Say how the tasks are doing."""
        if self._tasks != list(tasks):
            self._tasks = list(tasks)
            self._changed.set()

    def look(self, item: Object | None) -> None:
        """Have what was said said again where the object, as the watch has it now, says something else.

        A write is sometimes carried out after it was given up: an earlier one of this monitor, or the last one of a monitor
        that died.
        """
        if item is None or self._answer is None or version_of(item) <= version_of(self._answer):
            return
        if _share(item, self._said) == _share(self._answer, self._said) or time.monotonic() < self._again_from:
            return
        _logger.warning("the status of %s was written over: it is written again", self._workload)
        self._again_from = time.monotonic() + AGAIN
        self._applied, self._answer = "", None
        self._changed.set()

    def sign(self, monitor: MonitorStatus) -> None:
        """Say who says all this. The operator, which goes by it, needn't wait for something else to be said."""
        self.monitor = monitor
        self._changed.set()

    def say_switchover(self, status: SwitchoverStatus) -> None:
        """Say how a planned switchover is doing."""
        if self.switchover != status:
            self.switchover = status
            self._changed.set()

    def situate(self, status: SituationStatus | None) -> None:
        """Say in which situation the robot is; None for none."""
        if self.situation != status:
            self.situation = status
            self._changed.set()

    def follow(self, followed: Sequence[DependencyRecovery]) -> None:
        """Say after which recoveries of others was done what is done then."""
        if self.followed != list(followed):
            self.followed = list(followed)
            self._changed.set()

    def hurry(self) -> None:
        """Have what has changed written at once: others wait for it."""
        self._urgent.set()
        self._free.set()

    @contextlib.contextmanager
    def recovering(self) -> Iterator[None]:
        """A recovery is under way: what changes is written once it is over, or when it takes longer than UNDER_WAY."""
        self._free.clear()
        try:
            yield
        finally:
            self._free.set()

    def withdraw(self, type_: str) -> None:
        """Say a condition no longer: what it is about isn't there any more."""
        if self._conditions.pop(type_, None) is not None:
            self._changed.set()

    def record(self, progress: Progress) -> Recovery:
        """Add a finished recovery. One that failed like the last is told once, with its latest times."""
        fresh, before = progress.to_recovery(0), self._recoveries[0] if self._recoveries else None
        again = (
            before is not None
            and before.result == fresh.result == "Failed"
            and (before.from_pod, before.switchover) == (fresh.from_pod, fresh.switchover)
        )
        if again:
            self._recoveries.pop(0)
        else:
            self._count += 1
        recovery = progress.to_recovery(self._count)
        self._recoveries = [recovery, *self._recoveries][:KEPT]
        if progress.result == "Recovered":
            self._last_time = rfc3339(progress.moments.get("verified", progress.cursor))[:19] + "Z"
        monitor_metrics.recovered(recovery)
        self._changed.set()
        return recovery

    @property
    def spent(self) -> list[float]:
        """When the recoveries began that count against the policy's budget, in unix seconds."""
        return [datetime.fromisoformat(moment).timestamp() for moment in self._spent]

    def spend(self, moments: Sequence[float]) -> None:
        """Say when those began that count (unix seconds)."""
        told = [rfc3339(moment) for moment in moments]
        if told != self._spent:
            self._spent = told
            self._changed.set()

    @property
    def goals(self) -> list[str]:
        """The tasks that have goals, worked on or not, by what the task proxy said last."""
        return [task.action for task in self._tasks if task.active]

    @property
    def planned(self) -> float | None:
        """When a degraded instance was handed over last, in unix seconds; None for never, of the recoveries that are kept."""
        handed = (r for r in self._recoveries if r.planned and r.switchover is None)
        found = (r.moments.detected for r in handed if r.moments.detected is not None)
        times = [datetime.fromisoformat(moment).timestamp() for moment in found]
        return max(times, default=None)

    def event(self, kind: str, reason: str, message: str) -> None:
        """An Event on the RobotWorkload, written in the background."""
        if self.reference:
            tell = self._recorder.warning if kind == "Warning" else self._recorder.normal
            task = asyncio.ensure_future(tell(self.reference, reason, message))
            _background.add(task)
            task.add_done_callback(_background.discard)

    def _body(self) -> Object:
        status = RobotWorkloadStatus(
            active=self.active,
            health=self.health,
            failing_since=rfc3339(self.failing_since) if self.failing_since is not None else None,
            strategy=self.strategy,
            gate=self.gate,
            monitor=self.monitor,
            recovery_count=self._count,
            last_recovery_time=self._last_time,
            spent=self._spent or None,
            switchover=self.switchover,
            situation=self.situation,
            recoveries=self._recoveries,
            dependencies=self.followed or None,
            kept=in_short([entry.name for entry in self._kept if entry.taken_at is not None]) or None,
            state=self._kept or None,
            tasks=self._tasks or None,
            conditions=sorted(self._conditions.values(), key=lambda c: c.type),
        )
        return {
            "apiVersion": API_VERSION,
            "kind": "RobotWorkload",
            "metadata": {"name": self._workload, "namespace": self._namespace},
            "status": status.to_wire(),
        }

    async def run(self) -> None:
        """Apply the status when it has changed, until cancelled."""
        while True:
            await self._changed.wait()
            await self._settled()
            self._changed.clear()
            self._urgent.clear()
            try:
                await self.flush()
            except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
                if isinstance(error, ApiError) and error.not_found:
                    _logger.info("RobotWorkload %s is gone", self._workload)
                else:
                    _logger.warning("status not written: %s", error)
                self._changed.set()
                await asyncio.sleep(RETRY)

    async def _settled(self) -> None:
        """Wait for what will change together with what has changed."""
        latest = time.monotonic() + UNDER_WAY
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(QUIET):
                    await self._urgent.wait()
            if self._urgent.is_set() or self._free.is_set() or time.monotonic() >= latest:
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(latest - time.monotonic()):
                    await self._free.wait()

    async def flush(self) -> None:
        """Apply the status now, if it isn't what was applied last."""
        body = self._body()
        text = json.dumps(body, sort_keys=True)
        if text == self._applied:
            return
        # What was applied before is so no longer, even where no answer comes.
        self._applied, self._answer = "", None
        answer, unknown = await apply_declared(
            self._client, WORKLOADS, self._namespace, body, manager=MANAGER, subresource="status"
        )
        if unknown and unknown != self._unknown:
            _logger.warning("%s", lacking(WORKLOADS, unknown, "monitor"))
        self._unknown = unknown
        self._applied, self._said, self._answer = text, body["status"], answer


def _share(item: Object, said: Object) -> Object:
    """What an object has of a status that was applied to it: the rest is the operator's."""
    status = item.get("status") or {}
    types = {c["type"] for c in said["conditions"]}
    found = {key: status[key] for key in said if key in status}
    return found | {"conditions": {c["type"]: c for c in status.get("conditions") or [] if c["type"] in types}}


_background: set[asyncio.Future[None]] = set()


def in_short(names: Sequence[str]) -> str:
    """Names for a column of a table."""
    distinct = list(dict.fromkeys(names))
    more = f" and {len(distinct) - NAMED} more" if len(distinct) > NAMED else ""
    return ", ".join(distinct[:NAMED]) + more


def describe(recovery: Recovery) -> str:
    """A finished recovery in one line, for Events and logs."""
    tried = "; ".join(f"{a.strategy}: {a.result}{f' ({a.message})' if a.message else ''}" for a in recovery.attempts)
    if recovery.result != "Recovered" or recovery.recovery_seconds is None:
        return f"{recovery.reason}. Nothing verified: {tried}"
    if recovery.follows and len(recovery.attempts) == 1 and not recovery.from_pod:
        return (
            f"{recovery.reason}. {recovery.to_pod} is in control again after {recovery.strategy} in {recovery.recovery_seconds:.3f} s, "
            f"epoch {recovery.epoch}"
        )
    text = (
        f"{recovery.reason}. {recovery.to_pod} took over from {recovery.from_pod or 'no pod'} by {recovery.strategy} "
        f"in {recovery.recovery_seconds:.3f} s, epoch {recovery.epoch}"
    )
    if (waited := _waited(recovery)) is not None:
        text = f"{text}, of which it waited {waited:.1f} s for a pod"
    if recovery.moments.held is not None:
        text = f"{text}, after limits.budget had held it since {recovery.moments.held[11:19]} UTC"
    failed = in_vain(recovery)
    return f"{text}. Before that: {'; '.join(failed)}" if failed else text


def switched(recovery: Recovery) -> str:
    """A planned switchover in one line, for Events and logs."""
    last, first = recovery.moments.last_output, recovery.moments.first_output
    if recovery.result != "Recovered":
        tried = "; ".join(a.message for a in recovery.attempts if a.message)
        return f"{recovery.reason}. {recovery.from_pod} was let through again: {tried}"
    text = f"{recovery.reason}. {recovery.to_pod} took over from {recovery.from_pod} by {recovery.strategy}, epoch {recovery.epoch}"
    if last is None or first is None:
        return text
    gap = (datetime.fromisoformat(first) - datetime.fromisoformat(last)).total_seconds()
    return f"{text}. The robot got no command for {max(0.0, gap):.3f} s"


def _waited(recovery: Recovery) -> float | None:
    """Seconds for which a shared pool had no pod for it, by the strategy that recovered it; None where it had one at once."""
    queued, claimed = recovery.moments.queued, recovery.moments.claimed
    if queued is None or claimed is None:
        return None
    return (datetime.fromisoformat(claimed) - datetime.fromisoformat(queued)).total_seconds()


def in_vain(recovery: Recovery) -> list[str]:
    """The strategies that were carried out and didn't verify, each with its pod and why."""
    return [
        f"{a.strategy} with {a.pod or 'no pod'} was tried in vain: {a.message}"
        for a in recovery.attempts
        if a.result == "NotVerified"
    ]
