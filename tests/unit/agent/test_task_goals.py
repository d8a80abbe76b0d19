"""The agent as the only client of its instance's action server, against real processes."""

from __future__ import annotations

import asyncio
import base64
import os
import uuid

import pytest

from tests.unit.action_proxy.conftest import ABORTED, ACTION, CANCELED, HERE, SUCCEEDED, TYPE, start  # noqa: F401
from tests.unit.agent.conftest import Pod, eventually
from understudy.kube.agent_client import AgentRefused

pytestmark = pytest.mark.ros

OUTPUTS = [{"topic": "/cmd_vel", "type": "std_msgs/msg/String"}]
TREE = {"topic": {"name": "/cmd_vel", "type": "std_msgs/msg/String", "gap": "300ms"}}


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch, tmp_path):
    """This machine's loopback; the application and the agent are in the partition of their pod."""
    from understudy.api.kinds.task_spec import Task
    from understudy.ros.dds.profiles import instance_profiles_xml

    (tmp_path / "profiles.xml").write_text(instance_profiles_xml([Task(action=ACTION, type=TYPE)]))
    for name, value in {
        "ROS_DOMAIN_ID": str(10 + os.getpid() % 90),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(tmp_path / "profiles.xml"),
        "UNDERSTUDY_POD": "pool-abcde",
    }.items():
        monkeypatch.setenv(name, value)


class AgentEvents:
    """The events of an agent."""

    def __init__(self) -> None:
        self.goals: list[dict] = []
        self.feedback: list[dict] = []
        self.resends: list[int] = []

    def __call__(self, link, event) -> None:
        if "goal" in event:
            self.goals.append(event["goal"])
        elif "feedback" in event:
            self.feedback.append(event["feedback"])
        else:
            self.resends.append(event["resendGoals"])

    def goal_state(self, goal: str, state: str) -> dict | None:
        return next((g for g in self.goals if g["id"] == goal and g["state"] == state), None)


def goal_of(order: int) -> str:
    from rclpy.serialization import serialize_message
    from test_msgs.action import Fibonacci

    return base64.b64encode(serialize_message(Fibonacci.Goal(order=order))).decode()


def body(goal: str, order: int) -> dict:
    return {"goal": goal, "action": ACTION, "type": TYPE, "data": goal_of(order)}


@pytest.fixture
async def agent(dds, pod: Pod, links):
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot"}
    pod.start_agent()
    events = AgentEvents()
    links.append(link := pod.link(claim="", on_event=events))
    await link.wait_connected(60)
    await link.configure(TREE, OUTPUTS, 60.0)
    return link, events


async def test_goals_are_followed_and_executed_once_although_the_agent_is_killed(agent, pod: Pod, links, start):  # noqa: F811
    link, events = agent
    long, short, wrong, aborted = (uuid.uuid4().hex for _ in range(4))
    # Asked for before the server is there: it is waited for.
    await link.request("goal", body(short, 4))
    server = start("serve", ACTION, STEP="0.2")
    outside = start("client", ACTION, "3", UNDERSTUDY_POD="another-pod")
    await eventually(lambda: events.goal_state(short, "ended"), 60)
    assert events.goal_state(short, "ended")["status"] == SUCCEEDED
    assert len([f for f in events.feedback if f["id"] == short]) == 4
    for goal, order in ((long, 480), (wrong, 1000), (aborted, 510)):
        await link.request("goal", body(goal, order))
    await eventually(lambda: events.goal_state(long, "running") and events.goal_state(wrong, "rejected"), 60)
    await eventually(lambda: events.goal_state(aborted, "ended"), 60)
    assert events.goal_state(aborted, "ended")["status"] == ABORTED
    # Another proxy had ordered it too. The client may know of the rejection by now.
    await link.request("goal", body(wrong, 4))
    await eventually(lambda: len([g for g in events.goals if g["id"] == wrong and g["state"] == "rejected"]) == 2)
    assert not server.events_of("executing", goal=wrong)
    pod.kill(pod.agent)
    await eventually(lambda: not link.connected)
    pod.start_agent()
    await link.wait_connected(60)
    assert (await link.request("goals", {}))["goals"] == []
    events.goals.clear()
    await link.request("goal", body(long, 480))
    await eventually(lambda: events.goal_state(long, "running"), 60)
    assert len(server.events_of("executing", goal=long)) == 1
    assert (await link.request("cancel", {"goal": long})).items() >= {"known": True, "accepted": True}.items()
    await eventually(lambda: events.goal_state(long, "ended"), 60)
    assert events.goal_state(long, "ended")["status"] == CANCELED
    assert not (await link.request("cancel", {"goal": uuid.uuid4().hex}))["known"]
    # The server is in its pod's partition: a client of another one doesn't reach it.
    assert not outside.events_of("ready")


async def test_a_restarted_server_has_lost_its_goals(agent, start):  # noqa: F811
    link, events = agent
    goal = uuid.uuid4().hex
    server = start("serve", ACTION, STEP="0.2")
    await link.request("goal", body(goal, 499))
    await eventually(lambda: events.goal_state(goal, "running"), 60)
    server.kill()
    start("serve", ACTION)
    await eventually(lambda: events.goal_state(goal, "lost"), 60)


async def test_a_result_with_a_lost_answer_is_requested_again(agent, start):  # noqa: F811
    link, events = agent
    goal = uuid.uuid4().hex
    server = start("serve", ACTION, DROP="1")
    await link.request("goal", body(goal, 3))
    await eventually(lambda: events.goal_state(goal, "ended"), 60)
    assert events.goal_state(goal, "ended")["status"] == SUCCEEDED
    assert len(server.events_of("dropped")) == 1


async def test_impossible_orders_are_refused(agent):
    link, _ = agent
    with pytest.raises(AgentRefused, match="robots_msgs/action/Dock is not installed"):
        await link.request("goal", {**body(uuid.uuid4().hex, 1), "type": "robots_msgs/action/Dock"})
    with pytest.raises(AgentRefused, match="32 hex digits"):
        await link.request("goal", {**body("x", 1)})


async def test_a_recovery_tree_requests_the_goals_and_waits_until_they_are_sent(agent):
    link, events = agent
    tree = {"resend_goals": {}}
    running = asyncio.create_task(link.request("procedure", {"tree": tree, "within": 20, "name": "p"}, within=30))
    await eventually(lambda: events.resends, 60)
    assert not running.done()
    await link.request("resent", {"number": events.resends[0]})
    await running
