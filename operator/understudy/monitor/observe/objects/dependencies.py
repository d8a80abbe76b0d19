"""The workloads that the monitor's own workload depends on, and their effect on a failure of this workload.

The monitor reads the status and the gate of each by name. The operator lists these workloads in the settings, and grants the right to
read them. If it lists none, nothing is watched and no failure is held.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from datetime import UTC, datetime

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.robot_workload import Dependency, DependencyRecovery, RobotWorkloadSpec, RobotWorkloadStatus
from understudy.api.moments import unix
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.bring_up import BringUp
from understudy.failover.dependency import DueReaction, HeldFailure, Outage, UpstreamState, due, held, outage
from understudy.failover.interfaces import Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.reinitialize import Reinitialize
from understudy.failover.strategies.restart import Restart
from understudy.kube.client import WORKLOADS, Resource
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord
from understudy.kube.watched_collection import Reflector
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

_logger = logging.getLogger(__name__)

CONDITION = "DependencyFailed"
"""The condition for a failure that is held because the failure of another workload may have caused it."""

VERIFIED_WITHIN = 10.0
"""Seconds, in addition to its procedures, within which an instance that is initialized again must be seen to drive."""

RESTARTED_WITHIN = 60.0
"""Time limit of a restart in seconds, if the policy has no strategy Restart."""


class _Watched:
    """The status and the gate of one workload, each by a watch."""

    def __init__(self, view: ClusterView, name: str, wakeups: Wakeups) -> None:
        self._name = name

        def reflector(resource: Resource, item: str) -> Reflector:
            only = f"metadata.name={item}"
            return Reflector(view.client, resource, view.namespace, fields=only, on_change=wakeups.dependency_changed)

        self.statuses = reflector(WORKLOADS, name)
        self.gates = [reflector(resource, names.gate(name)) for resource in registry.GATE_RESOURCES]
        self._tasks: list[asyncio.Task[None]] = []
        self._cached_state: tuple[tuple[int, int], UpstreamState] = ((-1, -1), UpstreamState())

    def begin(self) -> None:
        """Start the watches."""
        self._tasks = [asyncio.create_task(one.run()) for one in (self.statuses, *self.gates)]

    def end(self) -> None:
        """Stop the watches."""
        for task in self._tasks:
            task.cancel()

    @property
    def synced(self) -> bool:
        """Whether the status has been read."""
        return self.statuses.synced.is_set()

    @property
    def state(self) -> UpstreamState:
        """The state of the workload according to its status and gate."""
        revision = (self.statuses.revision, sum(one.revision for one in self.gates))
        if self._cached_state[0] != revision:
            self._cached_state = (revision, self._read())
        return self._cached_state[1]

    def _read(self) -> UpstreamState:
        item = self.statuses.items.get(self._name)
        if item is None:
            return UpstreamState()
        gates = (one.items.get(names.gate(self._name)) for one in self.gates)
        gate = next((one for one in gates if one is not None), None)
        try:
            status = RobotWorkloadStatus.model_validate(item.get("status") or {})
            text = GateRecord.of(gate).recovery if gate is not None else ""
            return UpstreamState.of(status, Progress.model_validate_json(text) if text else None)
        except ValidationError as error:
            _logger.warning("what RobotWorkload %s says cannot be read: %s", self._name, error)
            return UpstreamState()


class Dependencies:
    """The workloads that one workload depends on."""

    def __init__(self, view: ClusterView, notices: Notices, wakeups: Wakeups) -> None:
        self._view, self._notices, self._wakeups = view, notices, wakeups
        self._settings: WorkloadSettings | None = None
        self._watched: dict[str, _Watched] = {}
        self._outages: dict[str, Outage] = {}
        self._followed: dict[str, str] | None = None
        """By name of the dependency, its last recovery that this workload has reacted to. None until read from the status of an
        earlier monitor."""
        self._noticed: float | None = None
        """Since when the health tree has failed without interruption; None if it does not fail."""
        self._reason = ""
        """The reason as first reported. Its figures may change with every evaluation, and the message should not."""

    # -- watches --------------------------------------------------------------------------------------------------------

    def follow(self, settings: WorkloadSettings | None) -> None:
        """Watch the workloads that the operator's settings name, and no others."""
        if settings is None or settings is self._settings:
            return
        self._settings, followed = settings, self._known()
        wanted = [one.name for one in settings.upstream]
        for name in self._watched.keys() - set(wanted):
            self._watched.pop(name).end()
            self._outages.pop(name, None)
        for name in wanted:
            if name not in self._watched:
                self._watched[name] = _Watched(self._view, name, self._wakeups)
                self._watched[name].begin()
        if not wanted:
            followed.clear()
            self._report()
            self._notices.withdraw(CONDITION)

    def update(self, now: float) -> None:
        """Note the present state of the dependencies. ``now`` is in Unix seconds."""
        if not self._watched:
            return
        for name, watched in self._watched.items():
            if watched.synced and (found := outage(self._outages.get(name), watched.state, now)) is not None:
                self._outages[name] = found
        self._skip_earlier_recoveries()

    def _skip_earlier_recoveries(self) -> None:
        """Skip the recovery of a dependency from before this monitor first read its status: the active instance needs no reaction to
        it."""
        followed = self._known()
        before = dict(followed)
        direct = {one.name for one in self._direct}
        for name in before.keys() - direct:
            del followed[name]
        for name in direct - before.keys():
            if self._watched[name].synced:
                last = self._watched[name].state.last
                followed[name] = last.id if last is not None else ""
        if followed != before:
            self._report()

    def _known(self) -> dict[str, str]:
        """Return, by name of the dependency, the recoveries that this workload has reacted to. First read from the status."""
        if self._followed is None:
            self._followed = {one.name: one.recovery for one in self._notices.status.followed}
        return self._followed

    @property
    def _direct(self) -> list[Dependency]:
        spec = self._view.spec
        return [one for one in spec.depends_on if one.name in self._watched] if spec is not None else []

    # -- a failure of this workload -------------------------------------------------------------------------------------

    def notice(self, onset: float, detected: float) -> None:
        """Note that the health tree fails, and report it at once: this workload may wait for its dependencies, and workloads that depend
        on this one must know."""
        if self._watched and self._noticed is None:
            self._noticed = detected
            self._notices.set(failing_since=onset)
            self._notices.request_write()

    def well(self, pod: str) -> None:
        """Note that the health tree does not fail."""
        self._noticed, self._reason = None, ""
        if self._holds:
            self._notices.condition(CONDITION, "False", "HealthyAgain", f"{pod} no longer fails.")

    def hold(self, reason: str, onset: float, now: float) -> float | None:
        """Return when to check a held failure again; None if the failure is not held."""
        if not self._watched:
            return None
        noticed = min(self._noticed, now) if self._noticed is not None else now
        reason = self._reason = self._reason or reason
        found = held(onset, noticed, now, depends_on=self._direct, outages=self._outages)
        if found is None:
            if self._holds:
                text = (
                    f"{reason}; it has lasted for {now - noticed:.1f} s and is treated as a failure of this workload."
                )
                self._notices.condition(CONDITION, "False", "OwnFailure", text)
            return None
        if found.name:
            self._report_held(found, reason)
        return found.until

    @property
    def _holds(self) -> bool:
        """Whether the status reports that a failure is held."""
        return bool(self._watched) and self._notices.status.reason(CONDITION) in ("Held", "Settling")

    def _report_held(self, found: HeldFailure, reason: str) -> None:
        until = datetime.fromtimestamp(found.until, UTC).strftime("%H:%M:%S UTC")
        if found.settling:
            why, then = (
                "Settling",
                f"is healthy again; if the failure continues, the monitor recovers this workload at {until}",
            )
        else:
            health = self._watched[found.name].state.health
            why, then = (
                "Held",
                f"is {health} and is recovered first; the monitor recovers this workload at {until} at the latest",
            )
        text = f"{found.name}, on which this workload depends, {then}"
        began = not self._holds
        self._notices.condition(CONDITION, "True", why, f"{reason}; {text}.")
        if began:
            _logger.warning("%s: %s", reason, text)
            self._notices.event("Warning", CONDITION, f"{reason}; {text}")

    # -- after the recovery of a dependency -----------------------------------------------------------------------------

    def due(self, active: Instance, now: float) -> DueReaction | None:
        """Return the recoveries of dependencies that the active instance must react to now; None if there are none."""
        if not self._watched or self._settings is None:
            return None
        states = {name: watched.state for name, watched in self._watched.items()}
        found = due(self._direct, self._settings.upstream, states, self._outages, followed=self._known(), now=now)
        if found is None:
            return None
        if (unix(active.created) or 0.0) >= found.since:
            _logger.info(
                "%s was created after this, so no procedure runs on it: %s", active.name, describe(found.follows)
            )
            self.note(found.follows)
            return None
        spec = self._view.spec
        if spec is None or not (restarts(found.follows, spec) or procedures(found.follows, spec)):
            self.note(found.follows)
            return None
        if not restarts(found.follows, spec) and not active.has_agent:
            text = (
                f"{describe(found.follows)}: the procedure cannot run on {active.name}, which has no agent, because the controller in "
                "spec.workloadRef created it. Use onRecovery: Restart, or spec.template instead of spec.workloadRef"
            )
            self._notices.event("Warning", "NoAgent", text)
            self.note(found.follows)
            return None
        return found

    def note(self, found: Sequence[DependencyRecovery]) -> None:
        """Note that this workload has reacted to these recoveries."""
        if found:
            self._known().update({one.name: one.recovery for one in found})
            self._report()

    def _report(self) -> None:
        followed = self._known()
        self._notices.set_followed(
            [DependencyRecovery(name=name, recovery=followed[name]) for name in sorted(followed)]
        )


def begin(
    found: Sequence[DependencyRecovery],
    active: PodIdentity,
    spec: RobotWorkloadSpec | None,
    *,
    onset: float,
    detected: float,
) -> Progress:
    """Return the record of the reaction of the active instance to these recoveries. Times are Unix seconds."""
    progress = Progress.begin(describe(found), last_healthy=onset, detected=detected)
    progress.follows = list(found)
    if spec is not None and restarts(found, spec):
        progress.failed = [active]
    else:
        progress.target = active
    return progress


def describe(found: Sequence[DependencyRecovery]) -> str:
    """Say which dependencies were recovered."""
    listed = ", ".join(one.name for one in found)
    return f"{listed}, on which this workload depends, {'was' if len(found) == 1 else 'were'} recovered"


def restarts(found: Sequence[DependencyRecovery], spec: RobotWorkloadSpec) -> bool:
    """Return whether the active pod is replaced after these recoveries."""
    followed = {one.name for one in found}
    return any(one.on_recovery == "Restart" for one in spec.depends_on if one.name in followed)


def procedures(found: Sequence[DependencyRecovery], spec: RobotWorkloadSpec) -> list[BringUp]:
    """Return the procedures that run on the active instance after these recoveries, each only once."""
    followed = {one.name for one in found}
    listed: dict[str, BringUp] = {}
    for index, one in enumerate(spec.depends_on):
        procedure = {
            "Reinitialize": BringUp.of("bringUp", spec.bring_up),
            "Procedure": BringUp.of(f"dependsOn[{index}].procedure", one.procedure),
        }.get(one.on_recovery)
        if one.name in followed and procedure is not None:
            listed.setdefault(procedure.digest, procedure)
    return list(listed.values())


def following(found: Sequence[DependencyRecovery], spec: RobotWorkloadSpec, choices: Sequence[Choice]) -> list[Choice]:
    """Return the reaction to these recoveries, followed by the policy's own ``choices`` in case the reaction does not succeed."""
    if restarts(found, spec):
        usual = next((one for one in choices if isinstance(one.strategy, Restart)), None)
        bring_up = BringUp.of("bringUp", spec.bring_up)
        return [usual or Choice(Restart(recovery=bring_up), RESTARTED_WITHIN), *choices]
    listed = procedures(found, spec)
    if not listed:
        return list(choices)
    name = "Reinitialize" if all(one.name == "bringUp" for one in listed) else "Procedure"
    within = sum(one.within for one in listed) + VERIFIED_WITHIN
    return [Choice(Reinitialize(name, listed), within), *choices]
