"""Instances that do what the ledger orders, without ROS: a goal is executed once for each id, as action servers do."""

from __future__ import annotations

import json
import uuid
from dataclasses import dataclass, field

from understudy.action_proxy.client_goals import ABORTED, CANCELED, SUCCEEDED, AttemptState
from understudy.action_proxy.control_state import ControlState, Peer, TaskRule
from understudy.action_proxy.goal_ledger import CancelAnswer, GoalAnswer, GoalLedger, Order, ResultAnswer

ACTION = "/goto"


@dataclass
class Instance:
    """An application and its agent."""

    uid: str
    executing: bool = False
    running: dict[str, None] = field(default_factory=dict)
    ended: dict[str, int] = field(default_factory=dict)
    rejects: bool = False
    withdrawn: set[str] = field(default_factory=set)
    """Goals that were cancelled although no client asked for that. A proxy without a journal sends them again."""
    refuses_cancel: bool = False
    starts: list[str] = field(default_factory=list)


class World:
    """A ledger, instances, and the answers that clients received."""

    def __init__(self, on_failover: str = "Resend", *instances: str) -> None:
        self.ledger = GoalLedger()
        self.now = 1000.0
        self.epoch = 0
        self.active = ""
        self.settled = True
        self.on_board = False
        self.is_confirmed = True
        self.rule = TaskRule(ACTION, "test_msgs/action/Fibonacci", on_failover, 2.0)
        self.instances = {uid: Instance(uid) for uid in instances or ("a", "b")}
        self.accepted: dict[str, bool] = {}
        self.results: dict[str, tuple[int, str]] = {}
        self.cancelled: list[CancelAnswer] = []
        self._requests: dict[tuple[str, int], str] = {}
        self._number = 0

    # -- the monitor ------------------------------------------------------------------------------------------------

    def switch(self, uid: str, *, settled: bool = True, work: bool = True) -> None:
        self.epoch += 1
        self.active, self.settled = uid, settled
        self.tell(work=work)

    def settle(self, settled: bool = True) -> None:
        self.settled = settled
        self.tell()

    def stand_in(self, on_board: bool = True) -> None:
        """An instance on board drives from now on, or no more."""
        self.on_board = on_board
        self.tell()

    def tell(self, *, work: bool = True) -> None:
        peers = tuple(Peer(i.uid, i.uid, "", 0, "", "", i.executing) for i in self.instances.values())
        state = ControlState(
            "w",
            self.epoch,
            self.active,
            self.settled,
            (self.rule,),
            peers,
            on_board=self.on_board,
            is_confirmed=self.is_confirmed,
        )
        self.ledger.place(state, self.now)
        self.ledger.connected = set(self.instances)
        self.go(work=work)

    def lose(self, uid: str) -> None:
        del self.instances[uid]
        self.tell()

    # -- clients ----------------------------------------------------------------------------------------------------

    def request(self, goal: str) -> tuple[str, int]:
        self._number += 1
        self._requests[("c", self._number)] = goal
        return ("c", self._number)

    def ask(self, *, work: bool = True) -> str:
        goal = uuid.uuid4().hex
        self.ledger.ask(ACTION, goal, "goal", self.request(goal), self.now)
        if work:
            self.go()
        return goal

    def cancel(self, goal: str = "", *, work: bool = True) -> None:
        self.ledger.cancel(ACTION, goal, 0, self.request(goal), self.now)
        if work:
            self.go()

    def want(self, goal: str) -> None:
        self.ledger.want_result(ACTION, goal, self.request(goal), self.now)
        self.go()

    # -- instances --------------------------------------------------------------------------------------------------

    def id_at(self, goal: str, uid: str) -> str:
        return self.ledger.goals[goal].attempts[uid].id

    def end(self, uid: str, goal: str, status: int = SUCCEEDED) -> None:
        """The application ends a goal."""
        instance, id = self.instances[uid], self.id_at(goal, uid)
        del instance.running[id]
        instance.ended[id] = status
        self.ledger.report(uid, id, AttemptState.ENDED, self.now, status=status, result=f"{uid}")
        self.go()

    def restart_application(self, uid: str) -> None:
        instance = self.instances[uid]
        lost, instance.running = list(instance.running), {}
        for id in lost:
            self.ledger.report(uid, id, AttemptState.LOST, self.now)
        self.go()

    def work(self) -> bool:
        """Let every instance execute its orders. Return whether there were any."""
        did = False
        for instance in list(self.instances.values()):
            for order in self.ledger.orders(instance.uid):
                did = self._obey(instance, order) or did
        return did

    def _open_at(self, uid: str, id: str) -> bool:
        attempts = [goal.attempts.get(uid) for goal in self.ledger.goals.values()]
        return any(attempt.open for attempt in attempts if attempt is not None and attempt.id == id)

    def _obey(self, instance: Instance, order: Order) -> bool:
        if order.held:
            return False
        if order.cancel and not order.withdrawn:
            instance.withdrawn.discard(order.id)
        if order.id in instance.ended:
            if not self._open_at(instance.uid, order.id):
                return False
            self.ledger.report(
                instance.uid, order.id, AttemptState.ENDED, self.now, status=instance.ended[order.id], result="old"
            )
            return True
        if order.id not in instance.running:
            if order.cancel:
                self.ledger.report(instance.uid, order.id, AttemptState.LOST, self.now)
                return True
            if instance.rejects:
                self.ledger.report(instance.uid, order.id, AttemptState.REJECTED, self.now)
                return True
            assert order.id not in instance.starts, "executed twice"
            instance.starts.append(order.id)
            instance.running[order.id] = None
            self.ledger.report(instance.uid, order.id, AttemptState.RUNNING, self.now)
            return True
        if order.cancel:
            self.ledger.cancel_answered(instance.uid, order.id, not instance.refuses_cancel, self.now)
            if instance.refuses_cancel:
                return True
            del instance.running[order.id]
            instance.ended[order.id] = CANCELED
            if order.withdrawn:
                instance.withdrawn.add(order.id)
            self.ledger.report(instance.uid, order.id, AttemptState.ENDED, self.now, status=CANCELED)
            return True
        return False

    # -- the proxy --------------------------------------------------------------------------------------------------

    def go(self, *, work: bool = True) -> None:
        """Conclude, answer and carry out until nothing changes."""
        for _ in range(50):
            self.answer()
            if not (work and self.work()):
                self.answer()
                return
        raise AssertionError("it doesn't come to rest")

    def answer(self) -> None:
        for answer in self.ledger.advance(self.now):
            goal = self._requests[tuple(answer.request)]
            if isinstance(answer, GoalAnswer):
                assert self.accepted.setdefault(goal, answer.accepted) == answer.accepted, "answered twice"
            elif isinstance(answer, ResultAnswer):
                found = (answer.status, answer.result)
                assert self.results.setdefault(goal, found) == found, "ended twice"
            else:
                self.cancelled.append(answer)

    def restart(self) -> None:
        """Kill the proxy's process and start it again; the monitor sends it the current state."""
        self.ledger = GoalLedger.from_wire(json.loads(json.dumps(self.ledger.to_wire())), self.now)
        self.tell()

    def later(self, seconds: float) -> None:
        end = self.now + seconds
        while (due := self.ledger.due(self.now)) is not None and due < end:
            self.now = max(self.now, due) + 0.001
            self.go()
        self.now = end
        self.go()


__all__ = ["ABORTED", "ACTION", "CANCELED", "SUCCEEDED", "World"]
