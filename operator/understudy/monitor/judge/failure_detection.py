"""Detects failures of the active instance: its pod is lost, or its health tree fails."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Monitoring
from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.clock import CLOCK
from understudy.failover.decide import Trigger
from understudy.failover.interfaces import Gate, Instance, Instances
from understudy.failover.reflex import ReflexSwitch
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.trees.core.debounce import Debounce
from understudy.trees.core.health_tree import Verdict

KNOWN_GRACE = 3.0
"""Seconds that a new monitor waits for the first samples of an instance that was healthy before, according to its
agent."""

HEARD_GRACE = 1.0
"""The same for an instance that this monitor has heard before, for example before somebody deleted the gate: discovery is done."""

UNREACHED = 4.0
"""Seconds for which the mux at the robot must report that it misses what this monitor receives. A mux that starts again has learned of the
writers by then, also on a busy machine."""

DEAD_AFTER = 0.1
"""Seconds without an output after which a pod without an object counts as dead."""


@dataclass(frozen=True)
class Failure:
    """The cause of a recovery. Times are Unix seconds."""

    reason: str
    onset: float
    detected: float
    trigger: Trigger = Trigger.HEALTH_FAILED
    taken: ReflexSwitch | None = None
    """The takeover, if the robot already follows a standby."""
    follows: Sequence[DependencyRecovery] = ()
    """The recoveries of dependencies, if the instance has not failed and only has to react to them."""

    @property
    def planned(self) -> bool:
        """Whether nothing failed: a degraded instance is handed over."""
        return self.trigger is Trigger.DEGRADED


class FailureDetector:
    """Judges the active instance. Times are Unix seconds."""

    def __init__(
        self,
        fleet: Instances,
        gate: Gate,
        agents: AgentConnections,
        observer: HealthObserver,
        driven_epoch: int | None = None,
    ) -> None:
        """``driven_epoch`` is the gate's epoch at which the active instance had driven before this monitor started, if that is known."""
        self._fleet, self._gate = fleet, gate
        self._agents, self._observer = agents, observer
        self._driven_epoch = driven_epoch
        self._debounce = Debounce()
        self._watched = ""
        """UID of the instance that is watched."""
        self._since = CLOCK.now()
        self._heard_from: float | None = None
        """From when on an instance that had driven before can be heard, by the process's clock as ``_since``; None for any other one."""
        self._expected_since = 0.0
        self._is_presumed_lost = False
        """Whether the instance is expected only because its node seems to be lost."""
        self._unreached_since = math.inf
        """Since when the mux at the robot has not heard it, although this monitor has; by the process's clock."""

    @property
    def since(self) -> float:
        """Since when the instance has been watched: messages from before do not count for it."""
        return CLOCK.to_system(self._since)

    def watch(self) -> None:
        """Start to watch an instance that has just become active: messages from before do not count for it."""
        self._judge_since(CLOCK.now())

    def restart(self, since: float | None = None) -> None:
        """Judge the active instance by the messages received since a time (Unix seconds); by default, from now on."""
        self._judge_since(CLOCK.of_system(since) if since is not None else CLOCK.now())
        self._debounce.clear()

    def _judge_since(self, since: float) -> None:
        self._watched = self._gate.state.active_uid
        self._since, self._heard_from, self._is_presumed_lost = since, None, False
        self._unreached_since = math.inf

    def lost(self, active: Instance | None, now: float) -> tuple[Failure | None, float | None] | None:
        """Return the failure if the active pod is lost, or when to check again. None if the pod is not lost. Needs no health tree.

        A pod on a node that Kubernetes has lost stays active, regardless of its object: its outputs show whether it runs.
        A pod that is being deleted still has its labels, so the gate can fence it at once. A pod whose object is gone
        (deleted by force) has no labels, and its process may continue for a moment: the gate cannot fence it, so the
        switch waits until it is silent. It does not wait while an instance on board drives: control never returns to a pod without an
        object, since nobody can ask its agent whether it is ready.
        """
        name = self._gate.state.active
        if active is not None and not active.leaving and active.running:
            return None
        onset = self.onset(name, now)
        if (
            active is None
            and not self._observer.drove_on_board
            and (silent := self._observer.last_from(name)) is not None
            and now - silent < DEAD_AFTER
            # In a StatefulSet, a successor has the same name: once it has an address, the messages are the successor's.
            and not any(i.name == name and i.ip for i in self._fleet.of_workload())
        ):
            return None, silent + DEAD_AFTER
        gone = "is gone" if active is None else "is being deleted" if active.leaving else "has stopped running"
        return Failure(f"pod {name} {gone}", onset, time.time(), Trigger.POD_LOST), None

    def verdict(self, active: Instance, now: float) -> Verdict:
        """Return the verdict of the active instance's health tree."""
        if self._watched not in ("", active.uid):
            self.restart()  # another monitor let it through a moment ago, and it has not sent anything yet
        self._watched = active.uid
        # ``since`` can lie in the future if it comes from another node's clock: then no message would count until that time.
        self._since = min(self._since, CLOCK.now())
        since = self.since
        if self._is_presumed_lost and self._agents.status(active) is not None:
            self._presume_alive()
        self._expect_samples(since)
        verdict = self._observer.verdict(now=now, since=since)
        if (
            verdict.state == "Failed"
            and verdict.onset is None
            and self._heard_from is not None
            and self._is_ready(active)
        ):
            self._doubt()
            verdict = self._observer.verdict(now=now, since=since)
        if verdict.state == "Failed" and (unheard := self._unheard(active)):
            words = f"this monitor has received nothing {unheard}, and the agent of {active.name} reports it as healthy"
            return Verdict("Starting", words, verdict.leaf, None)
        if verdict.state == "Starting":
            self._look_for(active, now, since)
        last_well = self._observer.last_well(active.name)
        if verdict.state == "Starting" and now - since > (KNOWN_GRACE if last_well is None else HEARD_GRACE):
            # The instance is older than this monitor or its own time in control: the agent's report counts, not the startup grace.
            status = self._agents.status(active)
            if status is not None and status.ready_at is not None and not status.ready:
                # The agent heard the outputs while no monitor did. This one may have heard them before ``since``, as before a recovery
                # that was given up. If nobody did, as after the restart of both, all that an earlier monitor kept is from before.
                heard = [sign for sign in (last_well, *(o.last for o in status.outputs.values())) if sign is not None]
                onset = min(now, max(status.ready_at, *heard)) if heard else now
                return Verdict("Failed", status.reason, verdict.leaf, onset)
        return self._reaching(active, verdict) if verdict.state == "Healthy" else verdict

    def _reaching(self, active: Instance, verdict: Verdict) -> Verdict:
        """Return the verdict on an instance whose outputs are healthy where this monitor is. They must arrive at the robot too."""
        if not (topic := self._observer.unreached(active.name)):
            self._unreached_since = math.inf
            return verdict
        self._unreached_since = min(self._unreached_since, CLOCK.now())
        if CLOCK.now() - self._unreached_since < UNREACHED:
            return verdict
        words = (
            f"the mux at the robot does not hear {topic} of {active.name}, which this monitor receives: the instance does not reach the "
            "robot"
        )
        return Verdict("Failed", words, verdict.leaf, CLOCK.to_system(self._unreached_since))

    def _look_for(self, active: Instance, now: float, since: float) -> None:
        """Shorten the grace of an instance that had driven before this monitor started, once discovery has found it.

        Discovery takes a moment after the start, and the network of this monitor or of the instance may be down. If the discovery server
        has just restarted, it may report the robot long before the instance. A monitor without a writer of the instance knows nothing
        about its silence, unless the instance's node is lost: Kubernetes reports the pod as not ready, its agent cannot be reached, and
        the monitor has discovered somebody else. The report alone proves nothing. After an outage of the API server, nodes count as lost
        that only could not renew their leases.
        """
        if self._driven_epoch is None:
            return
        if self._driven_epoch != self._gate.state.epoch:
            self._driven_epoch = None  # the gate was opened for another instance since, which is new
        elif self._observer.discovered(active):
            self._driven_epoch, self._heard_from = None, CLOCK.of_system(now)
            self._expect_samples(since)
        elif (
            not self._is_presumed_lost
            and not active.ready
            and self._agents.status(active) is None
            and self._observer.others_discovered(active)
        ):
            self._is_presumed_lost, self._heard_from = True, CLOCK.of_system(now)
            self._expect_samples(since)

    def _presume_alive(self) -> None:
        """Give the instance the time to be discovered that it has if its node is not lost: its agent has answered."""
        self._is_presumed_lost, self._heard_from, self._expected_since = False, None, 0.0
        self._observer.expect_samples(since=math.nan, heard_from=math.inf)

    def _is_ready(self, active: Instance) -> bool:
        status = self._agents.status(active)
        return status is not None and status.ready

    def _unheard(self, active: Instance) -> str:
        """Return whom this monitor never heard because discovery does not work for it, in words; empty if it does, or if the instance is
        not healthy by its agent.

        It has found nobody, not even the robot, or nobody has found this monitor: the discovery server cannot be reached, or was replaced
        twice within seconds. This monitor would hear no other instance either, and so verify none. Or one process of the robot and this
        monitor have not found each other: the agent receives its topic, and another instance would change nothing.
        """
        if not self._is_ready(active):
            return ""
        if topic := self._observer.unheard:
            return f"on {topic}"
        if self._observer.last_from(active.name) is not None:
            return ""
        found = self._observer.discovered(active) is not False or self._observer.others_discovered(active)
        return "from anybody" if not found or self._observer.hears_nobody else ""

    def _doubt(self) -> None:
        """Look for the instance again, within the startup grace: its agent receives what this new monitor never did.

        Discovery may have informed only one of the two sides, as while two discovery servers run, or on a link that loses packets.
        """
        self._presume_alive()
        self._driven_epoch = self._gate.state.epoch

    def _expect_samples(self, since: float) -> None:
        """Have the health tree expect the samples of an instance that had driven before and is discovered."""
        if self._heard_from is not None and since != self._expected_since:  # at first, and after the clock was set
            self._expected_since = since
            self._observer.expect_samples(since=since, heard_from=CLOCK.to_system(self._heard_from))

    def onset(self, pod: str, now: float) -> float:
        """Return when a pod was last seen to be healthy; ``now`` if it never was."""
        last = self._observer.last_well(pod)
        return last if last is not None and last <= now else now

    def well(self) -> None:
        """Note that the health tree does not fail."""
        self._debounce.clear()

    def counts_from(self, detected: float, monitoring: Monitoring) -> float:
        """Note that the tree failed at ``detected``. Return when that counts as a failure, given the policy's debounce."""
        return self._debounce.failed(detected, seconds(monitoring.debounce))
