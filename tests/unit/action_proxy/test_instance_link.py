"""The proxy's connection to an agent: an order is sent once, and again if it may have been lost."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

import pytest

from tests.support.agents import PRIVATE_KEY, IdleAgent
from understudy.action_proxy.client_goals import AttemptState
from understudy.action_proxy.control_state import Peer as Instance
from understudy.action_proxy.goal_ledger import Order
from understudy.action_proxy.instance_link import InstanceLink
from understudy.agent.control_channel import ControlChannel, Operation, Peer, Refused
from understudy.api.protocol.agent_messages import GateEpoch

FIRST, SECOND, THIRD = (f"{n:032x}" for n in (1, 2, 3))


class Agent(IdleAgent):
    """The control channel of an agent that notes its requests."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[str, str]] = []
        self.withdrawn: list[bool] = []
        """Of each cancel."""
        self.known: list[dict[str, Any]] = []
        self.refused_action = ""
        self.answers = asyncio.Event()
        """Set while cancels are answered."""
        self.answers.set()
        self.on_goal: Callable[[], None] = lambda: None
        self.sessions = ControlChannel(self)

    def operations(self) -> Mapping[str, Operation]:
        async def goal(body: Mapping[str, Any], peer: Peer) -> None:
            if body["action"] == self.refused_action:
                raise Refused("its type is not installed")
            self.asked.append(("goal", body["goal"]))
            self.on_goal()

        async def cancel(body: Mapping[str, Any], peer: Peer) -> dict[str, Any]:
            self.asked.append(("cancel", body["goal"]))
            self.withdrawn.append(body.get("withdrawn", False))
            await self.answers.wait()
            return {"known": True, "accepted": True}

        async def goals(body: Mapping[str, Any], peer: Peer) -> dict[str, Any]:
            self.asked.append(("goals", ""))
            return {"goals": self.known}

        async def resent(body: Mapping[str, Any], peer: Peer) -> None:
            self.asked.append(("resent", str(body["number"])))

        return {"goal": goal, "cancel": cancel, "goals": goals, "resent": resent}


class LinkRecorder:
    """Records the events that the link reports, and provides the orders."""

    def __init__(self) -> None:
        self.ordered: list[Order] = []
        self.states: list[tuple[str, AttemptState]] = []
        self.cancelled: list[str] = []
        self.taken_up: list[str] = []
        self.connections: list[bool] = []
        self.troubles: dict[str, str] = {}

    def epoch(self) -> GateEpoch:
        return GateEpoch("uid", 3)

    def connection_changed(self, uid: str, connected: bool) -> None:
        self.connections.append(connected)

    def orders(self, uid: str) -> list[Order]:
        return list(self.ordered)

    def goal_found(self, uid: str, goal: Mapping[str, Any]) -> None:
        self.taken_up.append(goal["id"])

    def goal_reported(self, uid: str, id: str, at: AttemptState, status: int, result: str) -> None:
        self.states.append((id, at))

    def cancel_answered(self, uid: str, id: str, accepted: bool) -> None:
        self.cancelled.append(id)

    def feedback_received(self, uid: str, id: str, data: bytes) -> None: ...

    def resend_requested(self, uid: str) -> None:
        self.ordered.append(order(THIRD))

    def goal_problem(self, uid: str, action: str, problem: str) -> None:
        self.troubles[action] = problem


def order(
    id: str, action: str = "/goto", *, cancel: bool = False, withdrawn: bool = False, held: bool = False
) -> Order:
    return Order(id, action, "test_msgs/action/Fibonacci", "", cancel, "note", withdrawn, held)


async def eventually(holds: Any, within: float = 20.0) -> None:
    end = time.monotonic() + within
    while not holds():
        assert time.monotonic() < end, f"not within {within} s"
        await asyncio.sleep(0.01)


@pytest.fixture
def agent() -> Agent:
    return Agent()


@pytest.fixture
def recorder() -> LinkRecorder:
    return LinkRecorder()


@pytest.fixture
async def link(agent: Agent, recorder: LinkRecorder) -> AsyncIterator[InstanceLink]:
    server = await agent.sessions.serve(0, host="127.0.0.1")
    port = server.sockets[0].getsockname()[1]
    peer = Instance("1", "robot-1", "127.0.0.1", port, IdleAgent.token.decode(), "", key=PRIVATE_KEY.hex())
    made = InstanceLink(peer, "robot", recorder)
    yield made
    await made.close()
    server.close()


async def test_orders_are_sent_once_and_in_order(agent: Agent, recorder: LinkRecorder, link: InstanceLink) -> None:
    recorder.ordered = [order(FIRST), order(SECOND)]
    link.wake()
    await eventually(lambda: len(agent.asked) == 3)
    link.wake()
    recorder.ordered.append(order(THIRD))
    link.wake()
    await eventually(lambda: len(agent.asked) == 4)
    assert agent.asked == [("goals", ""), ("goal", FIRST), ("goal", SECOND), ("goal", THIRD)]


async def test_the_connection_is_reported_when_it_is_made_and_when_it_has_ended(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    await eventually(lambda: recorder.connections == [True])
    agent.sessions.abort()
    await eventually(lambda: recorder.connections[:2] == [True, False])


async def test_goals_that_the_agent_has_are_reported_and_not_sent_again(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    agent.known = [{"id": FIRST, "state": "running", "status": 0, "result": "", "note": "note"}]
    recorder.ordered = [order(FIRST), order(SECOND)]
    await eventually(lambda: ("goal", SECOND) in agent.asked)
    assert ("goal", FIRST) not in agent.asked
    assert recorder.taken_up == [FIRST]
    assert recorder.states == [(FIRST, AttemptState.RUNNING)]


async def test_a_goal_that_was_rejected_is_sent_again_when_it_is_ordered_again(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    recorder.ordered = [order(FIRST)]
    await eventually(lambda: ("goal", FIRST) in agent.asked)
    agent.sessions.publish({"goal": {"id": FIRST, "state": "rejected", "status": 0, "result": ""}})
    await eventually(lambda: recorder.states == [(FIRST, AttemptState.REJECTED)])
    link.wake()
    await eventually(lambda: agent.asked.count(("goal", FIRST)) == 2)


async def test_a_goal_that_is_no_longer_ordered_is_cancelled(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    recorder.ordered = [order(FIRST)]
    await eventually(lambda: ("goal", FIRST) in agent.asked)
    recorder.ordered = []
    link.wake()
    await eventually(lambda: ("cancel", FIRST) in agent.asked)


async def test_an_order_that_is_withdrawn_while_others_are_sent_is_not_sent(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    """Its instance has rejected the goal meanwhile. It would be asked for it again, and then to cancel it."""
    recorder.ordered = [order(FIRST), order(SECOND)]
    agent.on_goal = lambda: recorder.ordered.remove(order(SECOND)) if order(SECOND) in recorder.ordered else None
    link.wake()
    await eventually(lambda: ("goal", FIRST) in agent.asked)
    recorder.ordered.append(order(THIRD))
    link.wake()
    await eventually(lambda: ("goal", THIRD) in agent.asked)
    assert SECOND not in {goal for _, goal in agent.asked}


async def test_the_goals_of_an_agent_are_asked_for_again(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    recorder.ordered = [order(FIRST)]
    await eventually(lambda: ("goal", FIRST) in agent.asked)
    agent.known = [{"id": SECOND, "state": "running", "status": 0, "result": "", "note": "note"}]
    link.ask_again()
    await eventually(lambda: recorder.taken_up == [SECOND])
    assert agent.asked.count(("goal", FIRST)) == 1


async def test_a_cancellation_is_requested_once(agent: Agent, recorder: LinkRecorder, link: InstanceLink) -> None:
    recorder.ordered = [order(FIRST, cancel=True)]
    await eventually(lambda: recorder.cancelled == [FIRST])
    link.wake()
    recorder.ordered.append(order(SECOND))
    link.wake()
    await eventually(lambda: ("goal", SECOND) in agent.asked)
    assert agent.asked.count(("cancel", FIRST)) == 1


async def test_a_cancellation_that_is_not_answered_keeps_no_other_order_waiting(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    """The application of a standby stands still. Its agent must know which goals have ended (seed 2450289)."""
    agent.answers = asyncio.Event()
    recorder.ordered = [order(FIRST, cancel=True), order(SECOND, cancel=True), order(THIRD)]
    link.wake()
    await eventually(lambda: {("cancel", FIRST), ("cancel", SECOND), ("goal", THIRD)} <= set(agent.asked))
    assert recorder.cancelled == []
    link.wake()
    agent.answers.set()
    await eventually(lambda: sorted(recorder.cancelled) == [FIRST, SECOND])
    assert agent.asked.count(("cancel", FIRST)) == 1


async def test_an_order_that_is_held_leaves_the_goal_where_it_is(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    recorder.ordered = [order(FIRST)]
    await eventually(lambda: ("goal", FIRST) in agent.asked)
    recorder.ordered = [order(FIRST, cancel=True, withdrawn=True, held=True), order(SECOND)]
    link.wake()
    await eventually(lambda: ("goal", SECOND) in agent.asked)
    assert ("cancel", FIRST) not in agent.asked
    recorder.ordered = [order(FIRST, cancel=True, withdrawn=True), order(SECOND)]
    link.wake()
    await eventually(lambda: agent.withdrawn == [True])


async def test_an_instance_learns_that_a_withdrawn_goal_has_ended(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    recorder.ordered = [order(FIRST, cancel=True, withdrawn=True)]
    await eventually(lambda: agent.withdrawn == [True])
    recorder.ordered = [order(FIRST, cancel=True)]
    link.wake()
    await eventually(lambda: agent.withdrawn == [True, False])


async def test_a_refused_goal_is_reported_and_does_not_block_others(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    agent.refused_action = "/dock"
    recorder.ordered = [order(FIRST, "/dock"), order(SECOND)]
    await eventually(lambda: ("goal", SECOND) in agent.asked)
    assert "pod robot-1" in recorder.troubles["/dock"]
    assert "its type is not installed" in recorder.troubles["/dock"]
    agent.refused_action = ""
    await eventually(lambda: recorder.troubles["/dock"] == "")


async def test_a_recovery_tree_receives_an_answer_after_its_goals_were_sent(
    agent: Agent, recorder: LinkRecorder, link: InstanceLink
) -> None:
    await eventually(lambda: agent.sessions.count)
    agent.sessions.publish({"resendGoals": 7})
    await eventually(lambda: ("resent", "7") in agent.asked)
    assert agent.asked.index(("goal", THIRD)) < agent.asked.index(("resent", "7"))
