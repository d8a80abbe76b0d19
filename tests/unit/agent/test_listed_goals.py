"""What an agent lists for a proxy that does not know its goals. No message is too large, whatever goals and results contain."""

from __future__ import annotations

import base64
import uuid
from collections.abc import AsyncIterator, Mapping
from typing import Any

import pytest

from tests.unit.action_proxy.conftest import ACTION, SUCCEEDED, TYPE, dds, eventually, start
from understudy.action_proxy.client_goals import ABORTED
from understudy.agent.control_channel import Peer
from understudy.agent.restoration import task_goals
from understudy.agent.restoration.task_goals import TaskGoals
from understudy.api.protocol import agent_messages
from understudy.ros.actions.calling_node import GraphLocation
from understudy.ros.runtime.node_options import own_context

__all__ = ["dds", "start"]  # fixtures

pytestmark = pytest.mark.ros

PROXY = Peer("robot", "", "127.0.0.1")


class Goals:
    """The goals of an instance, and the events about them."""

    def __init__(self, place: GraphLocation | None = None) -> None:
        self.events: list[Mapping[str, Any]] = []
        self.inner = TaskGoals("goals", lambda: place, self.events.append)

    async def order(self, data: bytes) -> str:
        goal = uuid.uuid4().hex
        await self.repeat(goal, data)
        return goal

    async def repeat(self, goal: str, data: bytes = b"") -> None:
        body = {"goal": goal, "action": ACTION, "type": TYPE, "data": base64.b64encode(data).decode()}
        await self.inner.goal(body, PROXY)

    async def listed(self) -> list[str]:
        """The listed goals, in a message that the other side can read."""
        answer = await self.inner.list({}, PROXY)
        agent_messages.encode({"id": 1, "ok": True, **answer})
        return [goal["id"] for goal in answer["goals"]]

    def ends(self, goal: str) -> list[Mapping[str, Any]]:
        found = [event["goal"] for event in self.events if "goal" in event]
        return [one for one in found if one["id"] == goal and one["state"] == "ended"]


@pytest.fixture
async def goals(dds: None) -> AsyncIterator[Goals]:
    """Goals that wait, because the agent has not joined the graph."""
    made = Goals()
    yield made
    await made.inner.close()


async def test_a_withdrawn_goal_that_has_ended_for_its_client_is_listed_as_one_that_was_cancelled(goals: Goals) -> None:
    goal = await goals.order(b"goal")
    await goals.inner.cancel({"goal": goal, "withdrawn": True}, PROXY)
    (listed,) = (await goals.inner.list({}, PROXY))["goals"]
    assert (listed["withdrawn"], bool(listed["data"])) == (True, True)
    await goals.inner.cancel({"goal": goal}, PROXY)
    (listed,) = (await goals.inner.list({}, PROXY))["goals"]
    assert (listed["withdrawn"], bool(listed["data"])) == (False, False)


async def test_an_aborted_goal_is_listed_for_sending_it_again_until_its_end_counts_for_its_client(
    goals: Goals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_goals, "_CANCELED", ABORTED)
    goal = await goals.order(b"goal")
    await goals.inner.cancel({"goal": goal}, PROXY)
    for has_data in (True, False):
        (listed,) = (await goals.inner.list({}, PROXY))["goals"]
        assert (listed["status"], bool(listed["data"])) == (ABORTED, has_data)
        await goals.inner.cancel({"goal": goal}, PROXY)


async def test_the_list_contains_as_many_goals_as_fit_into_a_message_the_unfinished_ones_first(goals: Goals) -> None:
    ended = await goals.order(b"")
    await goals.inner.cancel({"goal": ended}, PROXY)
    large = [await goals.order(bytes(9 << 20)) for _ in range(4)]
    small = await goals.order(b"small")
    assert await goals.listed() == [large[0], small, ended]


async def test_a_goal_that_did_not_fit_reports_its_end_when_it_is_ordered_or_cancelled_again(
    goals: Goals, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal = await goals.order(b"")
    await goals.inner.cancel({"goal": goal}, PROXY)
    monkeypatch.setattr(task_goals, "MOST_BYTES", 0)
    assert await goals.listed() == []
    assert len(goals.ends(goal)) == 1
    await goals.repeat(goal)
    assert len(goals.ends(goal)) == 2
    await goals.inner.cancel({"goal": goal}, PROXY)
    assert len(goals.ends(goal)) == 3


async def test_a_result_that_no_message_can_carry_is_left_out_and_the_goal_ends(
    dds: None, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rclpy.serialization import serialize_message
    from test_msgs.action import Fibonacci

    monkeypatch.setattr(task_goals, "MOST_IN_EVENT", 100)
    context = own_context()
    goals = Goals(GraphLocation(context))
    start("serve", ACTION, STEP="0.001")
    long = await goals.order(serialize_message(Fibonacci.Goal(order=100)))
    short = await goals.order(serialize_message(Fibonacci.Goal(order=3)))
    await eventually(lambda: goals.ends(long) and goals.ends(short))
    ((of_long,), (of_short,)) = goals.ends(long), goals.ends(short)
    assert (of_long["status"], of_long["result"]) == (SUCCEEDED, "")
    assert of_short["status"] == SUCCEEDED
    assert of_short["result"]
    await goals.inner.close()
    context.shutdown()
