"""Somebody who pauses, fences and resumes robots, as the command does (understudy.cli.control)."""

from __future__ import annotations

from collections.abc import Callable

from tests.unit.interleavings import apiserver, gates
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.apiserver import EPOCH, ApiServer
from understudy.api import names
from understudy.api.kinds.pause_spec import FENCE
from understudy.cli.control.fence import fencing
from understudy.failover.progress import rfc3339
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord


class Pauses:
    """The pauses of a run, and the gates that a user has closed."""

    def __init__(
        self,
        server: ApiServer,
        clock: Callable[[], float],
        note: Callable[[str], None],
        fenced: set[str],
    ) -> None:
        """``fenced`` gets the robots whose gate must stay closed."""
        self._server, self._clock, self._note, self._fenced = server, clock, note, fenced

    def is_paused(self, robot: str) -> bool:
        """Whether a robot is paused."""
        item = self._server.get("robotworkloads", (NAMESPACE, robot))
        return item is not None and "pause" in item["spec"]

    def pause(self, robot: str, reason: str = "maintenance") -> None:
        """Pause a robot."""
        self._note(f"{robot} is paused: {reason}")
        self._patch("robotworkloads", robot, {"spec": {"pause": {"owner": "somebody", "reason": reason}}})

    def resume(self, robot: str) -> None:
        """End the pause of a robot, if there is one."""
        if self.is_paused(robot):
            self._note(f"{robot} is resumed")
            self._fenced.discard(robot)
            resumed = {names.RESUMED: rfc3339(EPOCH + self._clock())}
            self._patch("robotworkloads", robot, {"metadata": {"annotations": resumed}, "spec": {"pause": None}})

    def fence(self, robot: str) -> None:
        """Pause a robot, and close its gate for as long."""
        self.pause(robot, f"{FENCE}the robot is in the way")
        if (found := gates.place(self._server, robot)) is not None:
            plural, gate = found
            generation = self._server.items["robotworkloads"][(NAMESPACE, robot)]["metadata"]["generation"]
            closed = fencing(gates.KINDS[plural], robot, GateRecord.of(gate), generation)
            self._patch(plural, names.gate(robot), closed)
            self._fenced.add(robot)

    def _patch(self, plural: str, name: str, body: Object) -> None:
        self._server.update(plural, (NAMESPACE, name), lambda item: apiserver.merged(item, body), "somebody")
