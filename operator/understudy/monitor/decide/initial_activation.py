"""Finds the pods that the gate may open for while no instance is active and no recovery is in progress."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.decide import Requirement
from understudy.failover.interfaces import Instance, Instances
from understudy.monitor.observe.agent_connections import AgentConnections


@dataclass(frozen=True)
class Candidates:
    """The running pods, and those of them that the gate may open for now."""

    running: Sequence[Instance]
    ready: Sequence[Instance]
    rightful: str = ""
    """The UID of the instance that drove until the gate was closed for a leak or deleted; empty for none."""

    @property
    def first(self) -> Instance:
        """The preferred pod: the one that drove before, a pod of the workload's own controller, then the oldest."""
        return min(self.ready, key=lambda i: (i.uid != self.rightful, not i.from_source, i.created, i.name))

    @property
    def unmet(self) -> Requirement | None:
        """The requirement that an initial activation lacks; None if it lacks none."""
        if self.ready:
            return None
        return Requirement("NoPodReady" if self.running else "NoPodRunning")


class InitialActivation:
    """Finds the candidates of one workload."""

    def __init__(self, fleet: Instances, agents: AgentConnections) -> None:
        self._fleet, self._agents = fleet, agents
        self._started = time.time()
        self._first_seen: dict[str, float] = {}
        """When each running pod was first seen to run, by its UID (Unix seconds)."""

    def candidates(self, policy: FailurePolicySpec, now: float, *, paused: bool, rightful: str = "") -> Candidates:
        """Return the pods that the gate may open for at a time (Unix seconds).

        For half of the policy's startupGrace, only ready pods of the workload's own controller count. After that, standbys count too,
        and if no pod is ready, pods that have run for as long: an application may need an answer of the robot before it publishes its
        outputs.
        ``rightful`` is the UID of the instance that drove until the gate was closed for a leak or deleted; it counts at once.
        """
        running = [i for i in self._fleet.of_workload() if i.usable and not i.held]
        ready = [i for i in running if not i.has_agent or self._agents.is_ready(i)[0]]
        if running and not paused:
            self._started = min(self._started, now)  # the clock may have been set back
        self._first_seen = {i.uid: min(self._first_seen.get(i.uid, now), now) for i in running}
        grace = seconds(policy.monitoring.startup_grace) / 2
        if now - self._started <= grace:
            return Candidates(running, [i for i in ready if i.from_source or i.uid == rightful], rightful)
        had_time = [i for i in running if i.uid == rightful or now - self._first_seen[i.uid] > grace]
        return Candidates(running, ready or had_time, rightful)
