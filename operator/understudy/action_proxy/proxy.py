"""The task proxy: serves the workload's actions to clients, and assigns their goals to the instances.

The proxy records every event in the ledger. It stores the conclusions in the journal before it carries them out, so that a process that is
killed at any time continues from there.
"""

from __future__ import annotations

import asyncio
import base64
import logging
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.action_proxy.client_goals import AttemptState
from understudy.action_proxy.control_state import ControlState, Peer, TaskRule
from understudy.action_proxy.goal_journal import GoalJournal
from understudy.action_proxy.goal_ledger import Answer, CancelAnswer, GoalAnswer, Order
from understudy.action_proxy.instance_link import InstanceLink
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.clock import CLOCK
from understudy.ros.actions.action_endpoints import (
    ActionServer,
    ActionType,
    CancelRequest,
    KnownGoal,
    RequestHandlers,
    renamed,
)
from understudy.ros.runtime.interface_types import TypeNotInstalled
from understudy.ros.runtime.served_node import ServedNode
from understudy.ros.runtime.service_exchange import RequestId

_logger = logging.getLogger(__name__)

RECENT = 60.0
"""Seconds after its end in which a goal of an earlier proxy is adopted, since its client may be waiting for the
result."""

SLACK = 0.002
"""Seconds after a deadline of the ledger at which the proxy wakes, so that the clock has surely passed the deadline."""


@dataclass
class _Served:
    """One action, and its last report."""

    rule: TaskRule
    server: ActionServer | None = None
    """None until it is open."""
    problem: str = ""
    troubles: dict[str, str] = field(default_factory=dict)
    """By the UID of an instance, why it cannot receive goals."""
    statuses: list[KnownGoal] | None = None
    unsent: list[Answer] = field(default_factory=list)


class Proxy:
    """Implements :class:`understudy.action_proxy.instance_link.Listener`."""

    def __init__(self, node: ServedNode, journal: GoalJournal) -> None:
        """Continue with the contents of the journal."""
        self._node, self._journal = node, journal
        self.on_report: Callable[[], None] = lambda: None
        """Called when there is a new report for the monitor."""
        self._ledger, self._rules = journal.load()
        self._served: dict[str, _Served] = {}
        self._links: dict[str, InstanceLink] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[Any]] = set()
        self._reported: dict[str, Any] = {}
        self._serve()
        self._conclude()

    # -- the monitor ------------------------------------------------------------------------------------------------

    def place(self, situation: ControlState) -> None:
        """Apply a state of control from the monitor."""
        before = self._ledger.situation
        self._ledger.place(situation, CLOCK.now())
        if (present := self._ledger.situation) is None or present != situation:
            return
        # The answers for tasks that were removed need their servers, which still exist here.
        self._conclude()
        self._rules = situation.rules
        self._serve()
        self._link(situation)
        if before is not None and before.active != situation.active and situation.active in self._links:
            # It may have goals of an earlier proxy, which counted for nothing while it was not active.
            self._links[situation.active].ask_again()
        self._conclude()

    def report(self) -> dict[str, Any]:
        """Return the report for the monitor: the state of each task."""
        tasks = []
        for served in self._served.values():
            goals = self._ledger.of_action(served.rule.action)
            troubles = [text for text in served.troubles.values() if text]
            tasks.append(
                {
                    "action": served.rule.action,
                    "active": sum(goal.open for goal in goals),
                    "unasked": sum(goal.unasked is not None for goal in goals),
                    "resent": self._ledger.resent.get(served.rule.action, 0),
                    "message": "; ".join([served.problem, *troubles] if served.problem else troubles),
                    "served": served.server is not None,
                }
            )
        situation = self._ledger.situation
        return {"tasks": tasks, "epoch": situation.epoch if situation else None}

    async def close(self) -> None:
        """Close all connections; goals continue at their instances."""
        if self._timer is not None:
            self._timer.cancel()
        for link in self._links.values():
            await link.close()
        for task in list(self._tasks):
            task.cancel()

    def epoch(self) -> GateEpoch:
        """Return the epoch of the gate as the monitor reported it last."""
        situation = self._ledger.situation
        return situation.gate if situation is not None else GateEpoch()

    def serving_at(self) -> GateEpoch | None:
        """Return the epoch of the gate once all tasks are served; None before, and if the monitor has reported none."""
        is_serving = all(served.server is not None or served.problem for served in self._served.values())
        return self.epoch() if self._ledger.situation is not None and is_serving else None

    # -- reports of instances ----------------------------------------------------------------------------------------

    def connection_changed(self, uid: str, connected: bool) -> None:
        """Record whether an instance's agent is connected."""
        (self._ledger.connected.add if connected else self._ledger.connected.discard)(uid)
        self._conclude()

    def orders(self, uid: str) -> Sequence[Order]:
        """Return the goals that an instance must have."""
        return self._ledger.orders(uid)

    def goal_found(self, uid: str, goal: Mapping[str, Any]) -> None:
        """Adopt a goal that the instance has, if it is not known here and has not ended long ago."""
        ended, ago = None, float(goal.get("ago", 0.0))
        if goal["state"] == "ended":
            if ago > RECENT:
                return
            ended = (int(goal["status"]), str(goal["result"]))
        elif goal["state"] not in ("waiting", "running"):
            return
        try:
            note, data = goal.get("note", ""), goal.get("data", "")
            withdrawn, cancelled = bool(goal.get("withdrawn")), bool(goal.get("cancelled"))
            self._ledger.adopt(
                uid, goal["id"], note, data, ended, CLOCK.now(), ago, withdrawn=withdrawn, cancelled=cancelled
            )
        except (KeyError, TypeError, ValueError) as error:
            _logger.error("goal %s of an earlier proxy cannot be adopted: %r", goal["id"], error)

    def goal_reported(self, uid: str, id: str, at: AttemptState, status: int, result: str) -> None:
        """Record the state of one of the instance's goals."""
        self._ledger.report(uid, id, at, CLOCK.now(), status=status, result=result)
        self._conclude()

    def cancel_answered(self, uid: str, id: str, accepted: bool) -> None:
        """Record the instance's answer to a cancel."""
        self._ledger.cancel_answered(uid, id, accepted, CLOCK.now())
        self._conclude()

    def feedback_received(self, uid: str, id: str, data: bytes) -> None:
        """Pass on the feedback of a goal under the client's id, if the instance decides about that goal."""
        goal = self._ledger.feedback_of(uid, id)
        served = self._served.get(goal.action) if goal else None
        if goal is not None and served is not None and served.server is not None:
            served.server.publish_feedback(renamed(data, goal.id))

    def resend_requested(self, uid: str) -> None:
        """Record that the instance's recovery tree requests the unfinished goals."""
        count = self._ledger.invite(uid)
        _logger.info("a recovery tree requested the unfinished goals: %d", count)
        self._conclude()

    def goal_problem(self, uid: str, action: str, problem: str) -> None:
        """Record why the instance cannot receive a goal of an action; empty once it has received one."""
        if (served := self._served.get(action)) is not None:
            served.troubles[uid] = problem
            self._send_state()

    # -- what clients do --------------------------------------------------------------------------------------------

    def _asked(self, action: str) -> RequestHandlers:
        def goal(request: RequestId, id: str, data: bytes) -> None:
            _logger.info("goal %s of %s asked for", id, action)
            self._ledger.ask(action, id, base64.b64encode(data).decode(), request, CLOCK.now())
            self._conclude()

        def cancel(request: RequestId, asked: CancelRequest) -> None:
            self._ledger.cancel(action, asked.goal, asked.until, request, CLOCK.now())
            self._conclude()

        def result(request: RequestId, id: str) -> None:
            self._ledger.want_result(action, id, request, CLOCK.now())
            self._conclude()

        return RequestHandlers(goal, cancel, result)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _conclude(self) -> None:
        """Draw the conclusions, store them, and carry them out."""
        now = CLOCK.now()
        answers = self._ledger.advance(now)
        try:
            self._journal.save(self._ledger, self._rules)
        except OSError as error:
            _logger.error("could not store the goals, so they are lost if the action proxy restarts: %s", error)
        for answer in answers:
            if (served := self._served.get(answer.action)) is not None:
                self._answer(served, answer)
        for served in self._served.values():
            self._publish(served)
        for link in self._links.values():
            link.wake()
        self._send_state()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if (due := self._ledger.due(now)) is not None:
            wait = max(0.0, due - now) + SLACK
            self._timer = asyncio.get_running_loop().call_later(wait, self._conclude)

    def _answer(self, served: _Served, answer: Answer) -> None:
        if served.server is None:
            served.unsent.append(answer)
            return
        request = RequestId(*answer.request)
        if isinstance(answer, GoalAnswer):
            _logger.info("a goal of %s is %s", answer.action, "accepted" if answer.accepted else "rejected")
            served.server.answer_goal(request, answer.accepted, answer.stamp)
        elif isinstance(answer, CancelAnswer):
            served.server.answer_cancel(request, answer.code, answer.goals)
        else:
            served.server.answer_result(request, answer.status, base64.b64decode(answer.result))

    def _publish(self, served: _Served) -> None:
        statuses = [
            KnownGoal(goal.id, goal.accepted, goal.status) for goal in self._ledger.of_action(served.rule.action)
        ]
        if served.server is not None and statuses != served.statuses:
            served.statuses = statuses
            served.server.publish_status(statuses)

    def _send_state(self) -> None:
        report = self.report()
        if report != self._reported:
            self._reported = report
            self.on_report()

    def _serve(self) -> None:
        """Open a server for each task, and close those of other actions."""
        rules: Mapping[str, TaskRule] = {rule.action: rule for rule in self._rules}
        for action in [a for a, served in self._served.items() if rules.get(a) != served.rule]:
            gone = self._served[action]
            if action in rules and rules[action].type == gone.rule.type:
                gone.rule = rules[action]
                continue
            del self._served[action]
            if gone.server is not None:
                self._spawn(gone.server.close())
        for action, rule in rules.items():
            if action not in self._served:
                self._served[action] = _Served(rule)
                self._spawn(self._open(self._served[action]))

    async def _open(self, served: _Served) -> None:
        action = served.rule.action
        try:
            type_ = await asyncio.to_thread(ActionType.of, served.rule.type)
        except (TypeNotInstalled, ValueError) as error:
            _logger.error("%s: %s", action, error)
            served.problem = str(error)
            self._send_state()
            return
        server = ActionServer(self._node, action, type_, self._asked(action))
        await server.open()
        _logger.info("serving %s", action)
        served.server = server
        unsent, served.unsent = served.unsent, []
        for answer in unsent:
            self._answer(served, answer)
        self._conclude()

    def _link(self, situation: ControlState) -> None:
        """Open a connection to each instance's agent, and close other connections."""
        wanted: Mapping[str, Peer] = {peer.uid: peer for peer in situation.peers}
        for uid, link in list(self._links.items()):
            now = wanted.get(uid)
            if now is None or _address(now) != _address(link.peer):
                del self._links[uid]
                self._ledger.connected.discard(uid)
                self._spawn(link.close())
                for served in self._served.values():
                    served.troubles.pop(uid, None)
        for uid, peer in wanted.items():
            if uid not in self._links:
                self._links[uid] = InstanceLink(peer, situation.workload, self)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _address(peer: Peer) -> tuple[str, int, str, str, str]:
    return peer.ip, peer.port, peer.token, peer.key, peer.claim
