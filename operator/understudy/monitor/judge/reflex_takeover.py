"""Detects whether the robot's readers, or the mux beside them, already follow the standby that the gate admits beside the active
instance."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import Reflex
from understudy.failover.interfaces import Gate, Instances
from understudy.failover.progress import PodIdentity
from understudy.failover.reflex import ReflexSwitch, switched
from understudy.kube.gates.base import Proof
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver

CHECK_PERIOD = 0.005
"""Seconds between checks while the active pod is silent."""

FAST_CHECKS_FOR = 0.5
"""Seconds after the deadline during which the monitor checks that often. A pod that is silent for longer may be idle."""


class ReflexTakeover:
    """Detects the reflex takeovers of one workload; there are none if it has no reflex. Times are Unix seconds."""

    def __init__(self, view: ClusterView, pods: Instances, gate: Gate, observer: HealthObserver, proof: Proof) -> None:
        self._view, self._pods, self._gate, self._observer, self._proof = view, pods, gate, observer, proof

    @property
    def reflex(self) -> Reflex | None:
        """The reflex of the workload's spec; None if it has none."""
        spec = self._view.spec
        return spec.gate.reflex if spec is not None else None

    @property
    def is_at_robot(self) -> bool:
        """Whether a mux switches, and not the robot's readers."""
        spec = self._view.spec
        return spec is not None and spec.gate.is_at_robot

    @property
    def switcher(self) -> str:
        """Who switches to the standby, for messages."""
        return "the mux" if self.is_at_robot else "the robot's readers"

    @property
    def topics(self) -> Sequence[str]:
        """The topics of the workload's outputs."""
        spec = self._view.spec
        return [output.topic for output in spec.outputs if output.topic] if spec is not None else []

    @property
    def deadline(self) -> float:
        """Seconds of silence after which the robot's readers accept the standby's messages; 0 if there is no reflex."""
        reflex = self.reflex
        return seconds(reflex.deadline) if reflex is not None else 0.0

    def detect(self, now: float) -> ReflexSwitch | None:
        """Return the takeover if the standby that the gate lets through drives the robot now."""
        state = self._gate.state
        if state.closed or not (deadline := self.deadline):
            return None
        if self.is_at_robot:
            return self._by_mux(state.active)
        if not state.admitted:
            return None
        if self._observer.ambiguous(state.active) or self._observer.ambiguous(state.admitted):
            return None
        for topic in self.topics:
            found = switched(
                self._observer.arrivals(topic, state.active),
                self._observer.arrivals(topic, state.admitted),
                deadline=deadline,
                now=now,
            )
            if found is not None:
                return ReflexSwitch(PodIdentity(name=state.admitted, uid=state.admitted_uid), *found)
        return None

    def _by_mux(self, active: str) -> ReflexSwitch | None:
        """Return the switch of the mux's own. It may be to another standby than the admitted one, if that was silent too."""
        if (found := self._proof.switched(active)) is None:
            return None
        name, last, first = found
        standby = next((one for one in self._pods.of_workload() if one.name == name and one.usable), None)
        return ReflexSwitch(PodIdentity(name=name, uid=standby.uid), last, first) if standby is not None else None

    def next_check(self, now: float) -> float | None:
        """Return when to check again, so that a takeover is noticed at once; None if the next tick is early enough."""
        state = self._gate.state
        if not state.admitted or not (deadline := self.deadline):
            return None
        lasts = [found[-1] for topic in self.topics if (found := self._observer.arrivals(topic, state.active))]
        due = [last + deadline for last in lasts if now < last + deadline + FAST_CHECKS_FOR]
        return max(min(due), now + CHECK_PERIOD) if due else None
