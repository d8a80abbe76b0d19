"""Clients that send goals, and what must hold of their goals."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from tests.unit.interleavings.commands import Commands
from tests.unit.interleavings.pod_agents import PodAgent
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.task_applications import data_of
from tests.unit.interleavings.task_proxies import Answer, Endpoints
from understudy.action_proxy.client_goals import ABORTED, CANCELED, SUCCEEDED, UNKNOWN
from understudy.ros.actions.action_endpoints import CancelRequest
from understudy.ros.runtime.service_exchange import RequestId

GIVEN_UP = 20.0
"""Seconds without an answer after which a client no longer waits for the decision about a goal."""

AGAIN = 5.0
"""Seconds after which a client asks again for the result of a goal: its request may have reached no proxy."""

CANCELS = 0.15
"""How often a client cancels a goal."""

TOGETHER = 5.0
"""Seconds after two proxies of a workload served together in which a client may receive the answers of both."""

ORDERED = 0.5
"""Seconds for which the order of a goal may be on its way to an instance that another one has ended, or wait for its application."""

_NAMES = {UNKNOWN: "unknown", SUCCEEDED: "succeeded", CANCELED: "cancelled", ABORTED: "aborted"}


@dataclass
class Goal:
    """One goal of a client."""

    id: str
    workload: str
    lasts: float
    sent_at: float
    accepted: bool | None = None
    cancelled: bool = False
    end: int | None = None
    ended_at: float = 0.0
    completed: bool = False
    """Whether an instance has reached it."""
    replaced: bool = False
    """Whether an instance has ended it for a newer one."""
    moved: bool = False
    """Whether the pod of its proxy has ended or was replaced, and the journal with it, while it was open."""
    stranded: bool = False
    """Whether only instances that the gate did not name had it then. The next proxy takes goals over from the one in control."""
    ungated: bool = False
    """Whether somebody deleted the gate, and with it the record of who drove, while it was open."""
    excused: bool = False
    """Whether two proxies served together while it was open."""

    @property
    def open(self) -> bool:
        """Whether its client waits for its end."""
        return self.accepted is True and self.end is None


@dataclass
class Clients:
    """One client for each workload."""

    robots: Robots
    endpoints: Endpoints
    aborts: bool
    """Whether goals are aborted at a failover."""
    broken: Callable[[str], None]
    note: Callable[[str], None]
    behind: Callable[[str], bool]
    """Whether a workload's monitor does not know of the last switch."""
    commands: Commands
    goals: dict[str, Goal] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("sent", "ended", "resumed", "cancelled"), 0))
    _begun: dict[str, dict[str, tuple[PodAgent | None, int]]] = field(default_factory=dict)
    """By goal, the UIDs of the instances that worked on it while they reached the robot, with the agents and processes that they had."""
    _requests: dict[RequestId, Goal] = field(default_factory=dict)
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    _together: dict[str, float] = field(default_factory=dict)
    _late: set[tuple[str, str]] = field(default_factory=set)
    """Goals that had ended for their clients when an instance, given by its UID, began to work on them."""

    # -- what clients do --------------------------------------------------------------------------------------------

    def send(self, workload: str) -> None:
        """Send a goal, if a server is present."""
        servers = self.endpoints.serving(workload)
        if not servers:
            return
        choices, now = self.robots.choices, self.robots.loop.time()
        made = Goal(f"{choices.getrandbits(128):032x}", workload, 0.5 + 6 * choices.random(), now)
        made.excused = len(servers) > 1
        self.goals[made.id] = made
        self.counts["sent"] += 1
        self.note(f"client of {workload}: goal {made.id[:6]}, {made.lasts:.1f} s of work")
        request, content = self._request(made), data_of(made.id, made.lasts)
        for server in servers:
            self.endpoints.deliver(server.process, server.process, server.handlers.goal, request, made.id, content)
        if choices.random() < CANCELS:
            self.robots.later(5 * choices.random(), self._cancel, made)

    def _request(self, goal: Goal) -> RequestId:
        made = RequestId(f"client of {goal.workload}", next(self._numbers))
        self._requests[made] = goal
        return made

    def _cancel(self, goal: Goal) -> None:
        if not goal.open:
            return
        goal.cancelled = True
        self.counts["cancelled"] += 1
        self.note(f"client of {goal.workload}: cancels {goal.id[:6]}")
        for server in self.endpoints.serving(goal.workload):
            asked = CancelRequest(goal.id, 0)
            self.endpoints.deliver(server.process, server.process, server.handlers.cancel, self._request(goal), asked)

    def _want_result(self, goal: Goal) -> None:
        if not goal.open:
            return
        request = self._request(goal)
        for server in self.endpoints.serving(goal.workload):
            self.endpoints.deliver(server.process, server.process, server.handlers.result, request, goal.id)
        self.robots.later(AGAIN, self._want_result, goal)

    def received(self, answer: Answer) -> None:
        """A client receives an answer. The first one counts."""
        goal = self._requests[answer.request]
        if answer.accepted is not None and goal.accepted is None:
            goal.accepted = answer.accepted
            self.note(f"client of {goal.workload}: {goal.id[:6]} is {'accepted' if answer.accepted else 'rejected'}")
            self._want_result(goal)
        elif answer.status is not None and goal.accepted:
            self._ended(goal, answer.status)

    # -- what must hold ---------------------------------------------------------------------------------------------

    def _ended(self, goal: Goal, status: int) -> None:
        what = f"{goal.id[:6]} of {goal.workload}"
        if goal.end is not None:
            return
        self.look([goal.workload])
        goal.end, goal.ended_at = status, self.robots.loop.time()
        self.counts["ended"] += 1
        self.note(f"client of {goal.workload}: {goal.id[:6]} {_NAMES[status]}")
        if goal.excused:
            return
        unknown = self.behind(goal.workload) or self._is_forgotten(goal) or goal.ungated
        if status == UNKNOWN and not (goal.moved and unknown):
            self.broken(f"goal {what} was accepted, and is lost")
        elif status == SUCCEEDED and not goal.completed:
            self.broken(f"goal {what} succeeded, and no instance has reached it")
        elif status == CANCELED and not (goal.cancelled or goal.moved):
            self.broken(f"goal {what} is cancelled, and nobody asked for it")
        elif status == ABORTED and not (self.aborts or goal.replaced):
            self.broken(f"goal {what} is aborted")

    def moves(self, workload: str) -> None:
        """The pod of a workload's proxy ends, or another one replaces it."""
        for goal in self.goals.values():
            if goal.workload == workload and goal.end is None:
                goal.moved = True
                goal.stranded |= not any(self.commands.drives(found) for found in self._having(goal))

    def gate_deleted(self, workload: str) -> None:
        """Somebody deletes the gate of a workload."""
        for goal in self.goals.values():
            goal.ungated |= goal.workload == workload and goal.end is None

    def _is_forgotten(self, goal: Goal) -> bool:
        """Whether the next proxy of a lost one can learn of a goal from no instance."""
        return goal.stranded or not any(self._having(goal))

    def _having(self, goal: Goal) -> Iterator[Running]:
        """The instances that have a goal, with an agent that knows it: one that was restarted does not."""
        for uid, (agent, restarts) in self._begun.get(goal.id, {}).items():
            found = self.robots.running[uid]
            if found.exists and found.restarts == restarts and self.robots.agents_of.get(uid) is agent:
                yield found

    def begun(self, found: Running, goal: str) -> None:
        """An instance begins to work on a goal."""
        known = self.goals[goal]
        self.note(f"{found.name}: works on {goal[:6]}")
        # The network may still let an instance through that the gate does not name, and its agent may have stood still with an order of
        # before that switch.
        if not found.through or (not self.commands.drives(found) and self.commands.may_be_on_the_way(found)):
            return
        by = self._begun.setdefault(goal, {})
        if by.keys() - {found.uid}:
            self.counts["resumed"] += 1
        by[found.uid] = self.robots.agents_of.get(found.uid), found.restarts
        self.look([known.workload])
        if known.excused:
            return
        if known.end is not None:
            self._late.add((goal, found.uid))
            if self.robots.loop.time() - known.ended_at > ORDERED:
                self.broken(
                    f"{found.name} begins to work on {goal[:6]} of {known.workload}, which had {_NAMES[known.end]}"
                )
        if known.accepted is False:
            self.broken(f"{found.name} begins to work on {goal[:6]} of {known.workload}, which was rejected")

    def completed(self, found: Running, goal: str) -> None:
        """An instance has reached a goal."""
        self.goals[goal].completed = True
        if (goal, found.uid) in self._late:
            self.broken(f"{found.name} completes {goal[:6]}, which had ended when it began")

    def replaced(self, found: Running, goal: str) -> None:
        """An instance has ended a goal for a newer one."""
        self.goals[goal].replaced = True

    def look(self, workloads: list[str]) -> None:
        """See whether two proxies serve together."""
        now = self.robots.loop.time()
        for workload in workloads:
            if len(self.endpoints.serving(workload)) > 1:
                self._together[workload] = now
            if now - self._together.get(workload, -TOGETHER) < TOGETHER:
                for goal in self.goals.values():
                    if goal.workload == workload and (goal.accepted is None or goal.open):
                        goal.excused = True

    def unrest(self) -> Iterator[str]:
        """What has not ended yet."""
        for goal in self.goals.values():
            if goal.open:
                yield f"goal {goal.id[:6]} of {goal.workload} has not ended"
            elif goal.accepted is None and self.robots.loop.time() - goal.sent_at < GIVEN_UP:
                yield f"goal {goal.id[:6]} of {goal.workload} is not decided"
