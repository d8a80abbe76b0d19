"""Whether the active instance has failed: its pod is lost, or its health tree fails."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Monitoring
from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.failover.decide import Trigger
from understudy.failover.interfaces import Gate, Instance, Instances
from understudy.failover.reflex import ReflexSwitch
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.trees.core.debounce import Debounce
from understudy.trees.core.health_tree import Verdict

KNOWN_GRACE = 3.0
"""Seconds that a new monitor waits for the first samples of an instance that its agent knows was healthy before."""

DEAD_AFTER = 0.1
"""Seconds without an output after which a pod whose object is gone counts as dead."""


@dataclass(frozen=True)
class Failure:
    """What a recovery is for, and since when; times are Unix seconds."""

    reason: str
    onset: float
    detected: float
    trigger: Trigger = Trigger.HEALTH_FAILED
    taken: ReflexSwitch | None = None
    """The takeover, if the robot follows a standby already."""
    follows: Sequence[DependencyRecovery] = ()
    """The recoveries of dependencies, if the instance has not failed and only has to react to them."""

    @property
    def planned(self) -> bool:
        """Whether nothing failed: a degraded instance is handed over."""
        return self.trigger is Trigger.DEGRADED


class FailureDetector:
    """Judges the active instance. Times are Unix seconds."""

    def __init__(self, fleet: Instances, gate: Gate, agents: AgentConnections, observer: HealthObserver) -> None:
        self._fleet, self._gate = fleet, gate
        self._agents, self._observer = agents, observer
        self._debounce = Debounce()
        self.since = time.time()
        """Since when the instance is watched: what was received before is not its own."""

    def watch(self) -> None:
        """Watch an instance that was just put in control: what was received before is not its own."""
        self.since = time.time()

    def restart(self, since: float | None = None) -> None:
        """Judge the active instance from what was received since a time (Unix seconds); without one, from now on."""
        self.since = since if since is not None else time.time()
        self._debounce.clear()

    def lost(self, active: Instance | None, now: float) -> tuple[Failure | None, float | None] | None:
        """Return the failure if the active pod is lost, or when to check again. None if it is not lost. No health tree is needed.

        A pod on a node that Kubernetes has lost stays active, regardless of its object: its outputs show whether it runs.
        A pod that is being deleted still has its labels, so the gate can fence it at once. One whose object is gone
        (deleted by force) has none, and its process may run on for a moment: fencing it is not possible, so the switch
        waits until it is silent.
        """
        name = self._gate.state.active
        if active is not None and not active.leaving and active.running:
            return None
        onset = self.onset(name, now)
        if (
            active is None
            and (silent := self._observer.last_from(name)) is not None
            and now - silent < DEAD_AFTER
            # Once a successor of the same name has an address, as in a StatefulSet, it is that one which is heard.
            and not any(i.name == name and i.ip for i in self._fleet.of_workload())
        ):
            return None, silent + DEAD_AFTER
        gone = "is gone" if active is None else "is being deleted" if active.leaving else "has stopped running"
        return Failure(f"pod {name} {gone}", onset, time.time(), Trigger.POD_LOST), None

    def verdict(self, active: Instance, now: float) -> Verdict:
        """The verdict of its health tree."""
        # From later on where the clock was set back, or by the clock of another node: until then nothing would count.
        self.since = min(self.since, now)
        verdict = self._observer.verdict(now=now, since=self.since)
        if verdict.state == "Starting" and now - self.since > KNOWN_GRACE:
            # This monitor is new and its instance is not: the report of its agent counts, not the grace for a start.
            status = self._agents.status(active)
            if status is not None and status.ready_at is not None and not status.ready:
                return Verdict("Failed", status.reason, verdict.leaf, status.ready_at)
        return verdict

    def onset(self, pod: str, now: float) -> float:
        """When a pod was last seen to be healthy; now if it never was."""
        last = self._observer.last_well(pod)
        return last if last is not None and last <= now else now

    def well(self) -> None:
        """The health tree holds, or may yet."""
        self._debounce.clear()

    def counts_from(self, detected: float, monitoring: Monitoring) -> float:
        """When a failure of the tree, if it was also detected at ``detected``, counts as one."""
        return self._debounce.failed(detected, seconds(monitoring.debounce))
