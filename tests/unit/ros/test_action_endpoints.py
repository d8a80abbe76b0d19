"""A generic client and server of actions, against rclpy's own."""

from __future__ import annotations

import asyncio
import contextlib
import time
import uuid

import pytest

from tests.unit.action_proxy.conftest import ABORTED, ACTION, CANCELED, SUCCEEDED, TYPE, dds, eventually, start  # noqa: F401

pytestmark = pytest.mark.ros


@pytest.fixture
async def served(dds):  # noqa: F811
    from understudy.ros.runtime.served_node import ServedNode

    made = ServedNode("tested")
    yield made
    await made.close()


def goal_of(order: int) -> bytes:
    from rclpy.serialization import serialize_message
    from test_msgs.action import Fibonacci

    return serialize_message(Fibonacci.Goal(order=order))


def sequence_of(result: bytes) -> list[int]:
    from rclpy.serialization import deserialize_message
    from test_msgs.action import Fibonacci

    return list(deserialize_message(result, Fibonacci.Result).sequence)


def result_of(*sequence: int) -> bytes:
    from rclpy.serialization import serialize_message
    from test_msgs.action import Fibonacci

    return serialize_message(Fibonacci.Result(sequence=sequence))


class TestClient:
    @pytest.fixture
    async def client(self, served):
        from understudy.ros.actions.action_endpoints import ActionClient, ActionType

        self.feedback: list[tuple[str, bytes]] = []
        made = ActionClient(
            served,
            ACTION,
            ActionType.of(TYPE),
            on_feedback=lambda goal, data: self.feedback.append((goal, data)),
        )
        await made.open()
        return made

    async def ready(self, client) -> None:
        """Wait for a server that has matched the client too: until then it drops its answers when CPU is scarce."""
        async with asyncio.timeout(60):
            while not await client.ready():
                await asyncio.sleep(0.02)
            for ask in (
                lambda: client.send_goal(uuid.uuid4().hex, goal_of(1000)),
                lambda: client.cancel(uuid.uuid4().hex),
                lambda: client.result(uuid.uuid4().hex),
            ):
                answered = False
                while not answered:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(ask(), 5)
                        answered = True

    async def test_several_simultaneous_goals_have_their_own_feedback_and_results(self, client, start):  # noqa: F811
        assert not await client.ready()
        server = start("serve", ACTION)
        await self.ready(client)
        ids = [uuid.uuid4().hex for _ in range(3)]
        before = time.time_ns()
        answers = await asyncio.gather(*(client.send_goal(goal, goal_of(4 + i)) for i, goal in enumerate(ids)))
        assert all(accepted for accepted, _ in answers)
        assert all(before - 1e9 < stamp < time.time_ns() + 1e9 for _, stamp in answers)
        async with asyncio.timeout(60):
            results = await asyncio.gather(*(client.result(goal) for goal in ids))
        assert [(status, len(sequence_of(data))) for status, data in results] == [(SUCCEEDED, 6 + i) for i in range(3)]
        from rclpy.serialization import deserialize_message

        for i, goal in enumerate(ids):
            mine = [deserialize_message(data, client.type.feedback) for g, data in self.feedback if g == goal]
            steps = [m.feedback.sequence[0] for m in mine]
            # What a starved reader misses is lost, as with every client.
            assert steps
            assert steps == sorted(set(steps) & set(range(4 + i)))
        assert {line["goal"] for line in server.events_of("executing")} == set(ids)

    async def test_goals_can_be_cancelled_aborted_rejected_and_unknown(self, client, start):  # noqa: F811
        start("serve", ACTION)
        await self.ready(client)
        async with asyncio.timeout(60):
            long, aborted, rejected = (uuid.uuid4().hex for _ in range(3))
            assert (await client.send_goal(long, goal_of(499)))[0]
            assert (await client.send_goal(aborted, goal_of(510)))[0]
            assert not (await client.send_goal(rejected, goal_of(1000)))[0]
            assert not (await client.send_goal(long, goal_of(3)))[0], "an id is taken once"
            assert (await client.result(aborted))[0] == ABORTED
            assert await client.cancel(long) == 0
            assert (await client.result(long))[0] == CANCELED
            assert (await client.result(uuid.uuid4().hex))[0] == 0
            assert await client.cancel(uuid.uuid4().hex) == 2


class Recorded:
    """What a server was asked."""

    def __init__(self) -> None:
        from understudy.ros.actions.action_endpoints import RequestHandlers

        self.goals: list = []
        self.cancels: list = []
        self.results: list = []
        self.asked = RequestHandlers(
            goal=lambda *args: self.goals.append(args),
            cancel=lambda *args: self.cancels.append(args),
            result=lambda *args: self.results.append(args),
        )


class TestServer:
    @pytest.fixture
    async def server(self, served):
        from understudy.ros.actions.action_endpoints import ActionServer, ActionType

        self.asked = Recorded()
        made = ActionServer(served, ACTION, ActionType.of(TYPE), self.asked.asked)
        await made.open()
        yield made
        await made.close()

    async def test_an_rclpy_client_receives_each_answer_when_it_is_given(self, server, start):  # noqa: F811
        from rclpy.serialization import serialize_message
        from test_msgs.action import Fibonacci

        from understudy.ros.actions.action_endpoints import CANCELING, EXECUTING, KnownGoal, renamed

        client = start("client", ACTION, "5", "7", "9")
        await eventually(lambda: len(self.asked.goals) == 3)
        (first, goal, data), (second, other, _), (third, rejected, _) = self.asked.goals
        assert data == goal_of(5)
        stamp = time.time_ns()
        server.answer_goal(third, False, 0)
        server.answer_goal(first, True, stamp)
        server.answer_goal(second, True, stamp)
        server.publish_status([KnownGoal(goal, stamp, EXECUTING), KnownGoal(other, stamp, EXECUTING)])
        await eventually(lambda: len(client.events_of("answered")) == 3)
        assert client.events_of("answered", goal=rejected, accepted=False)
        message = Fibonacci.Impl.FeedbackMessage(feedback=Fibonacci.Feedback(sequence=[42]))
        server.publish_feedback(renamed(serialize_message(message), other))
        await eventually(lambda: client.events_of("feedback", index=1, step=42))
        await eventually(lambda: len(self.asked.results) == 2)
        client.tell("cancel 0")
        await eventually(lambda: self.asked.cancels)
        ((request, asked),) = self.asked.cancels
        assert asked.goal == goal
        server.answer_cancel(request, 0, [(goal, stamp)])
        server.publish_status([KnownGoal(goal, stamp, CANCELING)])
        await eventually(lambda: client.events_of("canceling", index=0, code=0, goals=1))
        requests = {goal: request for request, goal in self.asked.results}
        server.answer_result(requests[other], SUCCEEDED, result_of(1, 2, 3))
        server.answer_result(requests[goal], CANCELED, b"")
        await eventually(lambda: client.events_of("ended", index=0, status=CANCELED, result=[]))
        await eventually(lambda: client.events_of("ended", index=1, status=SUCCEEDED, result=[1, 2, 3]))

    async def test_a_restarted_server_answers_requests_of_its_predecessor(self, dds, served, start):  # noqa: F811
        """As after a restart: the participant that took the request is gone."""
        from understudy.ros.actions.action_endpoints import ActionServer, ActionType
        from understudy.ros.runtime.served_node import ServedNode

        gone, asked = ServedNode("gone"), Recorded()
        server = ActionServer(gone, ACTION, ActionType.of(TYPE), asked.asked)
        await server.open()
        client = start("client", ACTION, "5")
        await eventually(lambda: asked.goals)
        ((request, _, _),) = asked.goals
        server.answer_goal(request, True, time.time_ns())
        await eventually(lambda: asked.results)
        ((waiting, _),) = asked.results
        await server.close()
        await gone.close()
        after = ActionServer(served, ACTION, ActionType.of(TYPE), Recorded().asked)
        await after.open()
        after.answer_result(waiting, SUCCEEDED, result_of(8))
        await eventually(lambda: client.events_of("ended", status=SUCCEEDED, result=[8]))
        await after.close()
