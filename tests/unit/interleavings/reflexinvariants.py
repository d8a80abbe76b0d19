"""What must hold, beside what always must (invariants.py):

- Whom a gate doesn't let through any more, the robot doesn't take any more. The network has a moment to follow, and a pod
  that was cut off from everybody is held. It may continue until its node has received the gate if the node was back before it could be
  noticed, where its agent had never heard from a monitor, and where a monitor has let it go on before it was shut out, or
  before that one could know. A pod whose object is gone no policy holds back.
- A process that starts after its agent was asked to give way is never taken, whoever is late.
- A gate lets the pod in control through and at most one standby, which is weaker at that moment. Letting one through, or no
  longer, is no commit: neither epoch nor control change. Each commit is of the next epoch, and lets one through alone.
- A robot whose gate lets a standby through that works and is reached is without commands for the deadline, a period and a moment at
  most, regardless of what happens to the pod in control, the monitor and the API server.
- A recovery that began with the reflex leaves the robot to the standby that took over, for as long as that works.
- Where the network is well and the monitor works, no robot is without commands for long while a standby works.

And in the end: each robot takes the commands of the pod that its gate names, every monitor hears the same, nobody who is
in control or stands by is held, and a standby is let through again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, cast

from tests.unit.interleavings import gates
from tests.unit.interleavings.invariants import Invariants, leaving
from tests.unit.interleavings.ownership import PERIOD
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.reflexrobots import TOLD_AGAIN, ReflexRobots
from understudy.api import names
from understudy.api.base import seconds
from understudy.failover.progress import Progress
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord

ENFORCED = 0.05
"""Seconds in which nodes follow a gate."""

UNNOTICED = 0.6
"""Seconds for which a node may be cut off without its pods being held."""

LOOK = 0.2
"""Seconds between two looks whether a robot is without commands."""

STARVED = 40.0
"""Seconds within which a monitor that works has a standby that works drive: the times that all strategies get, and those for which it waits
for the recovery of another monitor.
"""


class ReflexInvariants(Invariants):
    """What holds of the reflex, beside what always does."""

    most_through = 2

    def __init__(
        self, *arguments: Any, excused: Callable[[str], bool], says: Callable[[str], str], **more: Any
    ) -> None:
        """``excused`` tells whether a robot's monitor, or the network, can't be expected to work now; ``says`` what that says of
        the reflex.
        """
        super().__init__(*arguments, **more)
        self._excused, self._says = excused, says
        self.robots = cast(ReflexRobots, self._robots)
        self._shut_out: dict[str, dict[str, float]] = {}
        """By workload and UID, since when its gate doesn't let a pod through."""
        self._let: dict[str, tuple[str, str]] = {}
        self._let_since: dict[str, float] = {}
        self._driven: dict[str, float] = {}
        """By workload, when its robot last took a command."""
        self._starving: dict[str, float] = {}
        """By workload, since when its robot is without one although a standby and all else works."""
        self.taken: dict[str, str] = {}
        """By workload, whom its robot takes."""

    # -- gates ------------------------------------------------------------------------------------------------------

    def _stale(self, before: GateRecord, after: GateRecord, gate: str) -> None:
        return  # what a reader takes decides here

    def _ended_by_monitor(self, pod: Object, by: str) -> None:
        return

    def _named(self, record: GateRecord) -> tuple[str, ...]:
        return (*super()._named(record), *((record.admitted,) if record.admitted else ()))

    def _control(self, gate: Object) -> object:
        return GateRecord.of(gate).active_uid

    def _gate(self, old: Object | None, new: Object) -> None:
        super()._gate(old, new)
        record = GateRecord.of(new)
        workload = new["metadata"]["name"].removesuffix("-gate")
        before = GateRecord.of(old) if old is not None else None
        if record.admitted_uid and record.admitted_uid == record.active_uid:
            self._broken(f"{names.gate(workload)} names {record.active} twice")
        if before is not None and before.active_uid != record.active_uid and record.admitted:
            self._broken(f"the commit of {record.active} lets {record.admitted} through too")
        if record.admitted_uid and (before is None or before.admitted_uid != record.admitted_uid):
            self._admitted(record)
        self._note(workload, record)
        self.robots.later(ENFORCED + 0.001, self.routed, workload)
        if record.recovery and (before is None or before.epoch != record.epoch):
            self._recovering(workload, record)

    def take_up(self) -> None:
        """Note how gates are when a run begins."""
        for workload, gate in gates.everyone(self._server):
            self._note(workload, GateRecord.of(gate))

    def _note(self, workload: str, record: GateRecord) -> None:
        """Who is let through from now on, and who no more."""
        before, let = self._let.get(workload, ("", "")), (record.active_uid, record.admitted_uid)
        shut = self._shut_out.setdefault(workload, {})
        shut |= {uid: self.robots.now for uid in before if uid not in let}
        for uid in let:
            shut.pop(uid, None)
        if before != let:
            self._let[workload], self._let_since[workload] = let, self.robots.now

    def _recovering(self, workload: str, record: GateRecord) -> None:
        """A recovery has committed: what the reflex did is built upon."""
        recovery = Progress.model_validate_json(record.recovery)
        taken = recovery.taken_over
        is_over = recovery.result != "Running"  # the gate is closed for a leak
        if taken is None or record.fenced or is_over:
            return
        self.robots.counts["fell over"] += taken.uid == record.active_uid
        found = self.robots.running.get(taken.uid)
        if found is None or record.active_uid == taken.uid or not self._works(found) or self._leaves(taken.uid):
            return
        watching = [w.reader for w in self.robots.watching[workload] if w.process.alive]
        if all(reader.driver == taken.uid for reader in (self.robots.reader_of(workload), *watching)):
            self._broken(f"{workload} took {taken.name} by the reflex, and its gate names {record.active or 'nobody'}")

    def _admitted(self, record: GateRecord) -> None:
        """A standby is let through: its process is weaker than the one in control, unless that one was restarted just now."""
        active, standby = (self.robots.agents.get(uid) for uid in (record.active_uid, record.admitted_uid))
        self.robots.counts["let through"] += 1
        if active is None or standby is None or active.writer is None or standby.writer is None:
            return
        if active.process == 1 and standby.writer.strength >= active.writer.strength:
            self._broken(f"{record.admitted} is let through beside {record.active}, which is no stronger")

    def shut_out(self, workload: str, uid: str) -> bool:
        """Whether a workload's gate has shut a pod out."""
        return uid in self._shut_out.get(workload, {})

    # -- robots -----------------------------------------------------------------------------------------------------

    def routed(self, robot: str) -> None:
        robots, now = self.robots, self.robots.now
        driver = robots.reader_of(robot).driver
        if driver and driver != self.taken.get(robot):
            found = robots.running[driver]
            robots.noted(f"{robot} takes {found.name}")
            robots.counts["taken"] += 1
        if driver or self.taken.get(robot):
            self._driven[robot] = now  # also between two looks
        self.taken[robot] = driver
        if not driver or self._is_tampered(driver):
            return
        found, agent = robots.running[driver], robots.agents[driver]
        shut = self._shut_out.get(robot, {}).get(driver)
        if shut is None and found.exists and driver not in self._let[robot]:
            self._broken(f"{robot} takes {found.name}, which its gate has never let through")
        if shut is not None and now - shut > ENFORCED and found.exists and not self._unnoticed(found, shut):
            self._broken(f"{robot} takes {found.name}, which its gate shut out {now - shut:.3f} s ago")
        if agent.gave_way is not None and agent.process > agent.gave_way:
            self._broken(f"{robot} takes a process of {found.name} that started after it gave way")

    def _unnoticed(self, found: Running, shut: float) -> bool:
        """Whether its node may know only an old gate, and nobody could have held the pod: it was cut off so shortly, or before its
        agent received the list of witnesses, or was allowed to continue before the commit was made or known.
        """
        cut, back = self.robots.cut_at.get(found.node, 0.0), self.robots.back_at.get(found.node, 0.0)
        agent = self.robots.agents[found.uid]
        unheld = back - cut < UNNOTICED or agent.unfenced or agent.believed
        return unheld and back > shut - TOLD_AGAIN and self.robots.now - back < TOLD_AGAIN + ENFORCED

    def look(self) -> None:
        """Now and then: nobody waits in vain for commands."""
        for robot in sorted(self._let):
            self._look(robot)

    def _look(self, robot: str) -> None:
        robots, now = self.robots, self.robots.now
        if robots.reader_of(robot).driver:
            self._driven[robot] = now
            self._starving.pop(robot, None)
            return
        _, admitted = self._let[robot]
        deadline = seconds(robots.reflex.deadline) + PERIOD + ENFORCED + LOOK
        since = max(self._driven.get(robot, now), self._let_since[robot], self._reaches_since(admitted))
        if admitted and now - since > deadline:
            self._broken(f"{robot} takes nobody for {now - since:.3f} s although {admitted} is let through and works")
        working = [r.uid for r in robots.running.values() if r.robot == robot and self._works(r)]
        if self._excused(robot) or not working:
            self._starving.pop(robot, None)
        elif now - self._starving.setdefault(robot, now) > STARVED:
            self._broken(f"{robot} takes nobody for {STARVED} s although {' and '.join(working)} work, and its monitor")

    def _works(self, found: Running) -> bool:
        agent = self.robots.agents.get(found.uid)
        return (
            agent is not None
            and found.sends
            and found.exists
            and agent.writer is not None
            and not agent.hangs
            and not agent.holds
            and not self.robots.cuts.get(found.node)
        )

    def _leaves(self, uid: str) -> bool:
        """Whether somebody has deleted a pod, that works until it ends."""
        pods = self._server.items["pods"].values()
        return any(pod["metadata"]["uid"] == uid and leaving(pod) for pod in pods)

    def _reaches_since(self, uid: str) -> float:
        agent = self.robots.agents.get(uid)
        return agent.reaches_since or self.robots.now if agent is not None else self.robots.now

    # -- once all is calm -------------------------------------------------------------------------------------------

    def _undriven(self) -> Iterator[str]:
        yield from super()._undriven()
        for robot, (active, _) in sorted(self._let.items()):
            for whose, reader in [("it", self.robots.reader_of(robot))] + [
                (str(w.process), w.reader) for w in self.robots.watching.get(robot, ()) if w.process.alive
            ]:
                if reader.driver != active:
                    yield f"{robot}: {whose} takes {reader.driver or 'nobody'}, and its gate names {active}"

    def unrest(self) -> list[str]:
        return [*super().unrest(), *self._held(), *self._unarmed()]

    def _held(self) -> Iterator[str]:
        for found in self.robots.running.values():
            agent = self.robots.agents.get(found.uid)
            if not found.ended and agent is not None and agent.holds:
                yield f"pod {found.name} is held"

    def _unarmed(self) -> Iterator[str]:
        for robot, (active, admitted) in sorted(self._let.items()):
            waiting = [
                r for r in self.robots.running.values() if r.robot == robot and r.uid != active and self._works(r)
            ]
            if waiting and not admitted:
                yield f"{robot}: no standby is let through ({self._says(robot)})"
