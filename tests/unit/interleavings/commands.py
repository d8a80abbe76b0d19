"""What must hold of the commands that agents carry out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.unit.interleavings.pods import Running
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.kube.gates.base import GateRecord

ON_THE_WAY = 4.0
"""Seconds that a command may be on its way from the last confirmation of its epoch on: a monitor believes in one for three seconds."""


@dataclass(frozen=True)
class Driving:
    """The instance that a gate lets through."""

    uid: str
    epoch: int
    """From which on it does."""
    since: float


class Commands:
    """No instance that drives is commanded by what was decided before it was let through."""

    def __init__(self, clock: Callable[[], float], broken: Callable[[str], None]) -> None:
        self._clock, self._broken = clock, broken
        self._driving: dict[str, Driving] = {}
        """By workload."""
        self.refused = 0

    def see(self, workload: str, gate: GateRecord) -> None:
        """A gate was written."""
        known = self._driving.get(workload)
        if known is None or known.uid != gate.active_uid:
            self._driving[workload] = Driving(gate.active_uid, gate.epoch, self._clock())

    def may_be_on_the_way(self, found: Running) -> bool:
        """Whether what was sent to an instance before the last switch may still arrive there: it may have stood still meanwhile."""
        driving = self._driving.get(found.robot)
        return driving is not None and self._clock() - max(driving.since, found.sends_since) <= ON_THE_WAY

    def drives(self, found: Running) -> bool:
        """Whether the gate object names an instance."""
        driving = self._driving.get(found.robot)
        return driving is not None and driving.uid == found.uid

    def carried_out(self, found: Running, op: str, epoch: GateEpoch, by: str) -> None:
        """An agent carries out a command."""
        driving = self._driving.get(found.robot)
        if driving is None or driving.uid != found.uid or epoch.number >= driving.epoch:
            return
        after = self._clock() - driving.since
        if after > ON_THE_WAY:
            self._broken(
                f"{found.name} drives {found.robot} since epoch {driving.epoch}, and {after:.1f} s later it carries out "
                f"{op} of epoch {epoch.number} from {by}"
            )
