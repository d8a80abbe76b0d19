"""Records which goals exist at which instances, and concludes what to do: the rules of the task proxy, without ROS.

The proxy records every event in the ledger. Then :meth:`GoalLedger.advance` draws the conclusions. The orders for an
instance can be read at any time (:meth:`GoalLedger.orders`), and sent repeatedly. So no lost event, and no restart of
the proxy, of an agent or of the monitor, loses a goal or causes one to be executed twice:

- Only the active instance decides on a goal. Reports of others, including the old instance after a switch, change nothing
  for the client.
- A goal that has ended or is being cancelled is never sent again. A cancel that the old instance had not answered counts
  as accepted.
- An end that no client requested is withheld while a failure is detected or a recovery is in progress, in the first moments, and while
  the instance's agent is not connected: applications abort their goals when they receive the signal to end.
- An abort by an instance that could not reach the robot, because an instance on board drove it, is no end: the goal is sent again.
- A goal that a newer one has replaced (it was aborted while the newer one continues) has ended, and is not sent again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.action_proxy.client_goals import (
    ABORTED,
    AGAIN,
    CANCELED,
    MIRROR_AGAIN,
    SUCCEEDED,
    UNKNOWN,
    Attempt,
    AttemptState,
    Goal,
    GoalEnd,
    Phase,
)
from understudy.action_proxy.control_state import ControlState, TaskRule
from understudy.clock import CLOCK

UNDECIDED = 60.0
"""Seconds after which a goal that no instance has decided on is rejected: its client may have given up long ago."""

REFUSED = 30.0
"""Seconds for which a goal that was accepted once is offered to a new instance that rejects it."""

TOGETHER = 0.3
"""Seconds within which an application that ends aborts all its goals. A newer goal that continued for longer has replaced the older one."""

KEPT = 900.0
"""Seconds for which the result of an ended goal is available."""

MOST_KEPT = 128
"""Ended goals that are kept."""

MOST_BYTES = 4 << 20
"""Bytes (in base64) of the results of ended goals that are kept: the journal is written as a whole."""

EARLY = 15.0
"""Seconds for which a request for the result of a goal that is not known here is held while the instance in control can be asked. The goal
itself may come later, or from the instance: after the loss of a node, a client may hear two proxies until the node's kubelet has ended the
older one."""

MOST_EARLY = 1024
"""Most of these requests that are held."""

JUST_NOW = 10.0
"""Seconds before a restart for which answers are given again: the last ones may not have been sent."""

CANCEL_OK, CANCEL_REJECTED, CANCEL_UNKNOWN, CANCEL_ENDED = range(4)
"""Return codes of action_msgs/srv/CancelGoal."""

RequestKey = tuple[str, int]


@dataclass(frozen=True)
class GoalAnswer:
    """The answer that accepts or rejects a goal."""

    action: str
    request: RequestKey
    accepted: bool
    stamp: int


@dataclass(frozen=True)
class CancelAnswer:
    """The answer with the goals that are being cancelled: their ids, and when they were accepted."""

    action: str
    request: RequestKey
    code: int
    goals: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class ResultAnswer:
    """The answer with a result."""

    action: str
    request: RequestKey
    status: int
    result: str


Answer = GoalAnswer | CancelAnswer | ResultAnswer


@dataclass(frozen=True)
class Order:
    """A goal that an instance must have."""

    id: str
    action: str
    type: str
    data: str
    cancel: bool = False
    note: str = ""
    """What the instance stores with the goal (see :meth:`GoalLedger.adopt`)."""
    withdrawn: bool = False
    """Whether it is cancelled although no client asked for that: another instance is in control, or none."""
    held: bool = False
    """Whether nothing is done about it yet: it would be withdrawn, and the instance may be in control by now."""


@dataclass
class _Cancel:
    """A client's request to cancel goals, some of which an instance has not answered yet."""

    action: str
    waiting: set[str]
    cancelled: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _EarlyResult:
    """A client's request for the result of a goal that is not known yet."""

    action: str
    id: str
    request: RequestKey
    received: float


class GoalLedger:
    """All goals. Times (``now``) are of the process's clock (understudy.clock)."""

    def __init__(self) -> None:
        self.situation: ControlState | None = None
        """None until the monitor has reported the state of control. Until then no decision is made."""
        self._workload = ""
        """UID of the RobotWorkload whose goals they are; empty before it is known."""
        self.goals: dict[str, Goal] = {}
        self.resent: dict[str, int] = {}
        """Number of goals that another instance took over, by action."""
        self.connected: set[str] = set()
        """UIDs of the instances whose agents are connected: those that have not ended."""
        self._former: set[str] = set()
        self._invited: set[str] = set()
        self._cancels: dict[RequestKey, _Cancel] = {}
        self._early: list[_EarlyResult] = []
        self._asked: tuple[str, float] | None = None
        """UID of the instance in control, and since when it can be asked for goals that are not known here; None if it cannot."""
        self._answers: list[Answer] = []
        self._number = 0

    # -- what clients do --------------------------------------------------------------------------------------------

    def ask(self, action: str, id: str, data: str, request: RequestKey, now: float) -> None:
        """Record a goal from a client. An id that is known is rejected, as every action server does, but not if an instance had the goal of
        this very request from another proxy."""
        if (known := self.goals.get(id)) is not None:
            if known.request != request:
                self._answers.append(GoalAnswer(action, request, False, 0))
            elif known.phase is not Phase.PENDING:
                self._answers.append(GoalAnswer(action, request, True, known.accepted))
            return
        self._number += 1
        self._add(Goal(id, action, data, self._number, received=now, request=request))

    def cancel(self, action: str, id: str, until: int, request: RequestKey, now: float) -> None:
        """Record a client's request to cancel goals.

        These are one goal, the goals accepted up to a time (Unix nanoseconds), or, with neither, all.
        """
        mine = [g for g in self.goals.values() if g.action == action and g.phase is not Phase.PENDING]
        chosen = [g for g in mine if (not id and not until) or g.id == id or (until and g.accepted <= until)]
        open_ones = [goal for goal in chosen if goal.open]
        if not open_ones:
            code = CANCEL_OK if not id else CANCEL_ENDED if chosen else CANCEL_UNKNOWN
            self._answers.append(CancelAnswer(action, request, code, ()))
            return
        entry = self._cancels[request] = _Cancel(action, set())
        for goal in open_ones:
            if goal.phase is Phase.CANCELING:
                entry.cancelled.append(goal.id)
            else:
                entry.waiting.add(goal.id)
                goal.cancels.append(request)

    def want_result(self, action: str, id: str, request: RequestKey, now: float) -> None:
        """Record a client's request for a goal's result. That of a goal without a decision waits for the decision."""
        goal = self.goals.get(id)
        if goal is None or goal.action != action:
            self._early.append(_EarlyResult(action, id, request, now))
            return
        goal.results.append(request)
        if goal.end is not None:
            self._answers.append(ResultAnswer(action, request, goal.end.status, goal.end.result))

    # -- reports of instances ----------------------------------------------------------------------------------------

    def report(
        self, uid: str, id: str, at: AttemptState, now: float, *, status: int = UNKNOWN, result: str = ""
    ) -> None:
        """Record an instance's report of one of its goals. Reports of goals that it no longer has are ignored."""
        found = self._at(uid, id)
        if found is None:
            return
        goal, attempt = found
        if not attempt.open:
            return
        attempt.at, attempt.status = at, status
        attempt.after = now + (AGAIN if uid == goal.charge else MIRROR_AGAIN)
        if uid != goal.charge or uid != self._active or not goal.open:
            return
        if attempt.withdrawn and status != SUCCEEDED:
            if not attempt.open:
                goal.charge = ""  # it is sent again
            return
        if at in (AttemptState.RUNNING, AttemptState.ENDED):
            self._accept(goal, now)
            goal.refused_since = 0.0
        if at is AttemptState.ENDED:
            self._ended(goal, GoalEnd(status, result), now)
        elif at is AttemptState.REJECTED:
            self._rejected(goal, now)
        elif at is AttemptState.LOST:
            self._orphaned(goal, now)

    def adopt(
        self,
        uid: str,
        id: str,
        note: str,
        data: str,
        ended: tuple[int, str] | None,
        now: float,
        ago: float = 0.0,
        *,
        withdrawn: bool = False,
        cancelled: bool = False,
    ) -> None:
        """Adopt a goal that the active instance has and that is not known here, because the journal was lost.

        ``ended`` has the status and the result if the goal has ended in the meantime, ``ago`` seconds before. ``withdrawn`` is whether a
        proxy cancelled it without a client's request; ``cancelled`` whether one cancelled it because its client asked for that, or because
        it had ended. Raises KeyError, TypeError and ValueError for an invalid note.
        """
        if uid != self._active or not note:
            return
        goal = Goal.from_note(note, data, now)
        if goal.id in self.goals or goal.action not in self._rules:
            return
        self._add(goal)
        self._number = max(self._number, goal.number)
        goal.charge, goal.attempts[uid] = uid, Attempt(id)
        if cancelled and goal.phase is Phase.ACTIVE:
            goal.phase = Phase.CANCELING
        if goal.request and goal.accepted and _is_recent(goal.accepted, now):
            self._answers.append(GoalAnswer(goal.action, goal.request, True, goal.accepted))
        if ended is not None:
            goal.attempts[uid].at, goal.attempts[uid].status = AttemptState.ENDED, ended[0]
            self._accept(goal, now)
            if withdrawn and ended[0] != SUCCEEDED and data:
                goal.charge = ""  # it is sent again
            elif ended[0] == ABORTED and data:
                goal.unasked, goal.unasked_at = GoalEnd(*ended), now - ago
            else:  # an older agent does not give the data of a goal that has ended, so it cannot be sent again
                self._finish(goal, GoalEnd(*ended), now)

    def cancel_answered(self, uid: str, id: str, accepted: bool, now: float) -> None:
        """Record that an instance accepts or refuses to cancel a goal."""
        found = self._at(uid, id)
        if found is not None and uid == found[0].charge:
            self._cancel_decided(found[0], accepted)

    def feedback_of(self, uid: str, id: str) -> Goal | None:
        """Return the goal of an instance's feedback, if the instance decides about that goal; otherwise None."""
        found = self._at(uid, id)
        if found is None or uid != self._active or found[0].charge != uid or not found[0].open:
            return None
        return found[0]

    def invite(self, uid: str) -> int:
        """Record that an instance's recovery tree requests the unfinished goals. Returns their number."""
        self._invited.add(uid)
        return sum(goal.open and goal.phase is not Phase.PENDING for goal in self.goals.values())

    # -- reports of the monitor --------------------------------------------------------------------------------------

    def place(self, situation: ControlState, now: float) -> None:
        """Apply the state of control from the monitor. A state with an older epoch is ignored."""
        before = self.situation
        if before is not None and situation.epoch < before.epoch:
            return
        if self._workload and situation.workload_uid not in ("", self._workload):
            # Of a deleted workload with this name, on a volume that outlived it. No robot may move because of its goals.
            self._cancels.clear()
            self.goals.clear()
        self._workload = situation.workload_uid or self._workload
        self.situation = situation
        if before is not None and before.active and before.active != situation.active:
            self._former.add(before.active)
        self._former.discard(situation.active)
        known = {peer.uid for peer in situation.peers}
        self._former &= known
        self._invited &= known
        for goal in self._in_order():
            if not goal.open:
                continue
            if goal.action not in self._rules:
                self._give_up(goal, now)
            elif goal.charge and goal.charge != situation.active:
                self._former |= {goal.charge} & known
                if goal.charge in goal.attempts:
                    goal.attempts[goal.charge].withdrawn = True
                self._orphaned(goal, now)

    # -- conclusions -------------------------------------------------------------------------------------------------

    def advance(self, now: float) -> list[Answer]:
        """Draw the conclusions.

        Returns the answers to clients, which the proxy sends after it has stored the ledger.
        """
        if self.situation is not None:
            for goal in self._in_order():
                if goal.open:
                    self._advance(goal, now)
        self._forget(now)
        self._follow_asked(now)
        over = self._early[: max(0, len(self._early) - MOST_EARLY)]
        for early in [*over, *(early for early in self._early[len(over) :] if self._held_until(early) <= now)]:
            self._early.remove(early)
            self._answers.append(ResultAnswer(early.action, early.request, UNKNOWN, ""))
        for request, entry in list(self._cancels.items()):
            if not entry.waiting:
                del self._cancels[request]
                stamps = tuple((id, self.goals[id].accepted) for id in entry.cancelled if id in self.goals)
                code = CANCEL_OK if stamps else CANCEL_REJECTED
                self._answers.append(CancelAnswer(entry.action, request, code, stamps))
        answers, self._answers = self._answers, []
        return answers

    def due(self, now: float) -> float | None:
        """Return the latest time for the next :meth:`advance` if nothing else happens; None for never."""
        moments = [goal.ended_at + KEPT for goal in self.goals.values() if not goal.open]
        moments += [until for early in self._early if (until := self._held_until(early)) < math.inf]
        for goal in self.goals.values():
            if not goal.open:
                continue
            if goal.phase is Phase.PENDING:
                moments.append(goal.received + UNDECIDED)
            if goal.action in self._rules and self._counts_unasked(goal):
                moments.append(goal.unasked_at + self._rules[goal.action].abort_grace)
            moments += [attempt.after for attempt in goal.attempts.values() if attempt.after > now]
        return min(moments, default=None)

    def orders(self, uid: str) -> list[Order]:
        """Return the goals that an instance must have, in the order in which clients sent them.

        Of a goal that was withdrawn from the instance, or that the instance aborted, the end is ordered too, as a cancel: the instance
        ceases to offer it to proxies.
        """
        found = []
        for goal in self._in_order():
            attempt = goal.attempts.get(uid)
            if attempt is None or not (attempt.open or (attempt.may_be_offered and not goal.open)):
                continue
            rule = self._rules.get(goal.action)
            wanted = goal.open and not attempt.withdrawn and (uid == goal.charge or uid in self._mirrors)
            kind, cancel = rule.type if rule else "", goal.is_cancelled or not wanted
            # The instance keeps that a goal was withdrawn: a proxy without a journal sends it again. So it must not have ended.
            withdrawn = cancel and goal.open and not goal.is_cancelled
            held = withdrawn and self.situation is not None and not self.situation.is_confirmed
            found.append(Order(attempt.id, goal.action, kind, goal.data, cancel, goal.note(), withdrawn, held))
        return found

    def of_action(self, action: str) -> list[Goal]:
        """Return the accepted goals of an action, in their order."""
        return [g for g in self._in_order() if g.action == action and g.phase is not Phase.PENDING]

    # -- storage -----------------------------------------------------------------------------------------------------

    def to_wire(self) -> dict[str, Any]:
        """Return the whole ledger as one JSON object."""
        step = CLOCK.step()  # read once, since there may be many goals
        return {
            "workload": self._workload,
            "goals": [goal.to_wire(step) for goal in self._in_order()],
            "resent": self.resent,
            "former": sorted(self._former),
            "invited": sorted(self._invited),
            "early": [[early.action, early.id, early.request, early.received + step] for early in self._early],
            "cancels": [
                {
                    "request": request,
                    "action": entry.action,
                    "waiting": sorted(entry.waiting),
                    "cancelled": entry.cancelled,
                }
                for request, entry in self._cancels.items()
            ],
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any], now: float) -> GoalLedger:
        """Read what an earlier proxy stored. Its last answers are given again, since they may not have been sent.

        The active instance is not read from it, since another may be active by now.

        Raises KeyError, TypeError and ValueError if it is invalid.
        """
        made = cls()
        made._workload = str(data.get("workload", ""))
        made.goals = {goal.id: goal for goal in (Goal.from_wire(one, now) for one in data["goals"])}
        made.resent = dict(data["resent"])
        made._former, made._invited = set(data["former"]), set(data["invited"])
        for action, id, request, received in data.get("early", []):
            at = min(CLOCK.of_system(received), now)
            made._early.append(_EarlyResult(action, id, (request[0], request[1]), at))
        for entry in data["cancels"]:
            cancel = _Cancel(entry["action"], set(entry["waiting"]), list(entry["cancelled"]))
            made._cancels[(entry["request"][0], entry["request"][1])] = cancel
        made._number = max((goal.number for goal in made.goals.values()), default=0)
        for goal in made.goals.values():
            if goal.request and goal.phase is not Phase.PENDING and _is_recent(goal.accepted, now):
                made._answers.append(GoalAnswer(goal.action, goal.request, True, goal.accepted))
            if goal.end is not None and now - goal.ended_at < JUST_NOW:
                made._answer_results(goal, goal.end)
        return made

    # -- inside -----------------------------------------------------------------------------------------------------

    def _follow_asked(self, now: float) -> None:
        """Note whether the instance in control can be asked. If the monitor may not know which one that is, it cannot."""
        is_known = self.situation is not None and self.situation.is_confirmed and self._active in self.connected
        if not is_known:
            self._asked = None
        elif self._asked is None or self._asked[0] != self._active:
            self._asked = self._active, now

    def _held_until(self, early: _EarlyResult) -> float:
        return math.inf if self._asked is None else max(early.received, self._asked[1]) + EARLY

    def _add(self, goal: Goal) -> None:
        """Add a goal, with the requests for its result that came before it."""
        self.goals[goal.id] = goal
        mine = [early for early in self._early if (early.action, early.id) == (goal.action, goal.id)]
        for early in mine:
            self._early.remove(early)
            goal.results.append(early.request)

    @property
    def _active(self) -> str:
        return self.situation.active if self.situation else ""

    @property
    def _settled(self) -> bool:
        return self.situation is not None and self.situation.settled and bool(self.situation.active)

    @property
    def _rules(self) -> dict[str, TaskRule]:
        return {rule.action: rule for rule in self.situation.rules} if self.situation else {}

    @property
    def _mirrors(self) -> set[str]:
        """Standbys that receive every goal: the executing ones, and one whose recovery tree requested the goals."""
        peers = self.situation.peers if self.situation else ()
        wanted = {peer.uid for peer in peers if peer.executing or peer.uid in self._invited}
        return wanted - self._former - {self._active}

    def _in_order(self) -> Sequence[Goal]:
        return sorted(self.goals.values(), key=lambda goal: goal.number)

    def _at(self, uid: str, id: str) -> tuple[Goal, Attempt] | None:
        for goal in self.goals.values():
            attempt = goal.attempts.get(uid)
            if attempt is not None and attempt.id == id:
                return goal, attempt
        return None

    def _accept(self, goal: Goal, now: float) -> None:
        if goal.phase is Phase.PENDING:
            goal.phase, goal.accepted = Phase.ACTIVE, int(CLOCK.to_system(now) * 1e9)
            if goal.request is not None:
                self._answers.append(GoalAnswer(goal.action, goal.request, True, goal.accepted))

    def _rejected(self, goal: Goal, now: float) -> None:
        """Handle a rejection by the active instance.

        It is the answer to the client, unless another instance had accepted the goal.
        """
        if goal.phase is Phase.PENDING:
            if self._settled:
                self._drop(goal)
            return
        goal.refused_since = goal.refused_since or now
        if now - goal.refused_since >= REFUSED:
            self._finish(goal, GoalEnd(ABORTED, ""), now)

    def _ended(self, goal: Goal, end: GoalEnd, now: float) -> None:
        """Handle an end at the instance in charge. An abort may be that of an application that received the signal to end, also of a goal
        that its client wants to cancel."""
        if end.status == SUCCEEDED or (goal.is_cancelled and end.status != ABORTED):
            self._finish(goal, end, now)
        else:
            goal.unasked, goal.unasked_at = end, now

    def _drop(self, goal: Goal) -> None:
        """Reject a goal for its client."""
        if goal.request is not None:
            self._answers.append(GoalAnswer(goal.action, goal.request, False, 0))
        self._answer_results(goal, GoalEnd(UNKNOWN, ""))
        del self.goals[goal.id]

    def _give_up(self, goal: Goal, now: float) -> None:
        """Reject or abort a goal whose action is no longer a task."""
        if goal.phase is Phase.PENDING:
            self._drop(goal)
        else:
            self._finish(goal, GoalEnd(ABORTED, ""), now)

    def _orphaned(self, goal: Goal, now: float) -> None:
        """Handle that the instance that worked on a goal is no longer active."""
        goal.charge = ""
        if goal.phase is Phase.PENDING:
            return
        if goal.is_cancelled:
            self._finish(goal, GoalEnd(CANCELED, ""), now)
        elif goal.unasked is not None and self._replaced(goal):
            self._finish(goal, goal.unasked, now)
        elif self._rules[goal.action].on_failover == "Abort":
            self._finish(goal, GoalEnd(ABORTED, ""), now)
        goal.unasked = None

    def _void(self, goal: Goal, now: float) -> None:
        """Handle an end at an instance that could not reach the robot as one of an application that has lost the goal."""
        if (attempt := goal.attempts.get(goal.charge)) is not None:
            attempt.at, attempt.after = AttemptState.LOST, now + AGAIN
        self._orphaned(goal, now)

    def _counts_unasked(self, goal: Goal) -> bool:
        """Whether an end that no client requested counts, once its grace is over."""
        return goal.unasked is not None and self._settled and goal.charge in self.connected

    def _replaced(self, goal: Goal) -> bool:
        """Whether a newer goal continued when this one was ended."""
        return any(
            other.action == goal.action
            and other.number > goal.number
            and other.phase is not Phase.PENDING
            and (other.unasked is None or other.unasked_at - goal.unasked_at >= TOGETHER)
            and (other.open or (other.ended_at >= goal.unasked_at and not other.unasked_at))
            for other in self.goals.values()
        )

    def _cancel_decided(self, goal: Goal, accepted: bool) -> None:
        for request in goal.cancels:
            if (entry := self._cancels.get(request)) is not None:
                entry.waiting.discard(goal.id)
                if accepted:
                    entry.cancelled.append(goal.id)
        if goal.cancels and accepted and goal.open:
            goal.phase = Phase.CANCELING
        goal.cancels = []

    def _finish(self, goal: Goal, end: GoalEnd, now: float) -> None:
        self._cancel_decided(goal, end.status == CANCELED)
        goal.phase, goal.end, goal.ended_at, goal.unasked = Phase.ENDED, end, now, None
        goal.data = ""  # it is never sent again
        self._answer_results(goal, end)

    def _answer_results(self, goal: Goal, end: GoalEnd) -> None:
        self._answers += [ResultAnswer(goal.action, request, end.status, end.result) for request in goal.results]

    def _advance(self, goal: Goal, now: float) -> None:
        situation, rule = self.situation, self._rules[goal.action]
        assert situation is not None
        if goal.phase is Phase.PENDING and now - goal.received >= UNDECIDED:
            self._drop(goal)
            return
        if goal.unasked is not None and situation.on_board:
            self._void(goal, now)
        if self._counts_unasked(goal) and now - goal.unasked_at >= rule.abort_grace:
            assert goal.unasked is not None
            self._finish(goal, goal.unasked, now)
            return
        there = goal.attempts.get(goal.charge)
        if goal.is_cancelled and goal.unasked is None and (there is None or not there.open):
            # No instance has it, so there is nothing to wait for.
            self._finish(goal, GoalEnd(CANCELED, ""), now)
            return
        active = situation.active
        if active and not goal.charge and self._may_move(goal, rule):
            self._move(goal, active, now)
        elif active and goal.charge == active:
            attempt = goal.attempts[active]
            if attempt.at is AttemptState.REJECTED and attempt.after <= now:
                goal.attempt(active)
        if goal.phase is Phase.ACTIVE and not goal.cancels:
            there = goal.attempts.get(goal.charge)
            works = there is not None and there.at is AttemptState.RUNNING
            for uid in sorted(self._mirrors if works else self._mirrors & self._invited):
                self._mirror(goal, uid, now)
        self._withdraw(goal)

    def _may_move(self, goal: Goal, rule: TaskRule) -> bool:
        """Whether a goal that no instance works on may be given to the active one.

        After an outage, the monitor may learn of a new instance before it learns that their pod was replaced: the proxy that replaced
        this one may have answered the client meanwhile.
        """
        assert self.situation is not None
        if not self.situation.is_confirmed and goal.attempts and self._active not in goal.attempts:
            return False
        if rule.on_failover != "Tree" or goal.phase is Phase.PENDING or not goal.attempts:
            return True
        return self._settled or self._active in self._invited

    def _move(self, goal: Goal, active: str, now: float) -> None:
        """Put the active instance in charge of a goal.

        If it already has the goal as a mirror it continues, otherwise the goal is sent.
        """
        attempt = goal.attempts.get(active)
        lost = attempt is not None and attempt.at is AttemptState.LOST
        if lost and attempt is not None and attempt.after > now:
            return
        if goal.phase is not Phase.PENDING and not lost:
            self.resent[goal.action] = self.resent.get(goal.action, 0) + 1
        goal.charge, goal.refused_since = active, 0.0
        if attempt is None or not attempt.open:
            goal.attempt(active)

    def _mirror(self, goal: Goal, uid: str, now: float) -> None:
        attempt = goal.attempts.get(uid)
        if attempt is None or (not attempt.open and attempt.status != SUCCEEDED and attempt.after <= now):
            goal.attempt(uid)

    def _withdraw(self, goal: Goal) -> None:
        """Withdraw a goal from former mirrors. One of them may be put in control while it cancels the goal."""
        if goal.open and self.situation is not None and self.situation.is_confirmed:
            kept = self._mirrors | {goal.charge}
            for uid, attempt in goal.attempts.items():
                attempt.withdrawn |= attempt.open and uid not in kept

    def _forget(self, now: float) -> None:
        """Forget ended goals after some time, the oldest first."""
        ended = sorted((g for g in self.goals.values() if not g.open), key=lambda g: g.ended_at, reverse=True)
        size = 0
        for index, goal in enumerate(ended):
            size += len(goal.end.result) if goal.end else 0
            over = index >= MOST_KEPT or (index > 0 and size > MOST_BYTES)
            if over or now - goal.ended_at >= KEPT:
                del self.goals[goal.id]


def _is_recent(accepted: int, now: float) -> bool:
    """Whether a goal was accepted (Unix nanoseconds) so recently that its client may not have received the answer."""
    return now - CLOCK.of_system(accepted * 1e-9) < JUST_NOW
