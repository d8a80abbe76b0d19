"""The agent runs procedures on real managed nodes beside it, and says how far its instance was brought."""

from __future__ import annotations

import asyncio

import pytest

from tests.support.agents import status_of
from tests.support.golden import assert_golden
from tests.unit.agent.conftest import Pod, eventually
from tests.unit.agent.localization import OUTPUTS, TREE, WITHIN, localize, run
from understudy.kube.agent_client import AgentLink, AgentRefused
from understudy.trees.languages.procedure_notations import compose

pytestmark = pytest.mark.ros

ACTIVATE = {"set_lifecycle": {"node": "/localizer", "state": "active"}}
CHECK = {"lifecycle_is": {"node": "/localizer", "state": "active"}}


async def connected(pod: Pod, links: list[AgentLink], **configuration) -> AgentLink:
    links.append(link := pod.link())
    await link.wait_connected(WITHIN)
    await link.configure(TREE, OUTPUTS, 20.0, **configuration)
    return link


async def test_an_initialized_standby_is_ready_and_stays_ready_when_its_agent_restarts(robot: Pod, links):
    localize(robot)
    link = await connected(robot, links, standby={"brought": "init:1", "tree": False})
    assert (await status_of(link)).ready is False
    assert (await status_of(link)).reason == "not initialized yet"

    await link.procedure(ACTIVATE, WITHIN, name="initialization", brought="init:1")

    status = await link.wait_for(lambda s: s.ready, WITHIN)
    assert (status.initialized, status.procedure) == ("init:1", "")
    assert (await robot.page("/ready"))[0] == 200
    robot.kill(robot.agent)
    robot.start_agent()
    again = robot.link()
    links.append(again)
    assert (await again.wait_for(lambda s: s.ready, WITHIN)).initialized == "init:1"


async def test_an_instance_initialized_by_another_procedure_is_not_ready(robot: Pod, links):
    localize(robot)
    link = await connected(robot, links, standby={"brought": "init:1", "tree": False})
    await link.procedure(ACTIVATE, WITHIN, name="initialization", brought="init:1")
    await link.configure(TREE, OUTPUTS, 20.0, standby={"brought": "init:2", "tree": False})
    assert (await link.wait_for(lambda s: not s.ready, WITHIN)).reason == "not initialized yet"


async def test_a_failed_procedure_reports_its_leaf_and_the_reason(robot: Pod, links):
    localize(robot)
    link = await connected(robot, links, standby={"brought": "init:1", "tree": False})
    wrong = {
        "sequence": [
            ACTIVATE,
            {"parameter_is": {"node": "/localizer", "name": "speed", "value": 3.0}},
        ]
    }
    with pytest.raises(AgentRefused, match=r"initialization\.sequence\[1\]\.parameter_is: parameter speed of node"):
        await link.procedure(wrong, WITHIN, name="initialization", brought="init:1")
    status = await status_of(link)
    assert not status.ready
    assert status.initialized == "begun:init:1"
    assert_golden("agent", status.reason, "initialization.sequence[1].parameter_is")


WRITTEN = {
    "xml": """<root BTCPP_format="4"><BehaviorTree ID="Up"><Sequence>
  <SetLifecycle node="/localizer" state="active"/>
  <ParameterIs node="/localizer" parameter="speed" value="3.0"/>
</Sequence></BehaviorTree></root>""",
    "osc": """import osc.understudy
scenario up:
    do serial:
        set_lifecycle("/localizer", lifecycle_state!active)
        parameter_is("/localizer", "speed", "3.0")
""",
}
FAILS = {"xml": "line 3, column 3: <ParameterIs>", "osc": "line 5, column 9: parameter_is\\(\\)"}


@pytest.mark.parametrize("form", ["xml", "osc"])
async def test_a_procedure_in_another_language_does_the_same_and_reports_places_in_its_text(
    robot: Pod, links, form: str
):
    localize(robot)
    link = await connected(robot, links, standby={"brought": "up:1", "tree": False})
    found = compose(form, WRITTEN[form], check=False, path="bringUp")
    with pytest.raises(AgentRefused, match=f"bringUp, {FAILS[form]}: parameter speed of node"):
        await link.procedure(found.node, WITHIN, name="bringUp", places=found.places)
    check = compose("xml", CHECK_XML, check=True, path="readinessCheck")
    await link.configure(
        TREE, OUTPUTS, 20.0, standby={"check": check.node, "places": check.places, "period": 0.1, "brought": ""}
    )
    status = await link.wait_for(lambda s: "is active, not inactive" in s.check, WITHIN)
    assert_golden("agent", status.check, "line 1, column 49", "LifecycleIs", "/localizer is active, not inactive")


CHECK_XML = (
    '<root BTCPP_format="4"><BehaviorTree ID="Ready"><LifecycleIs node="/localizer" state="inactive"/>'
    "</BehaviorTree></root>"
)


async def test_a_tree_that_never_ends_fails_after_its_timeout(robot: Pod, links):
    link = await connected(robot, links)
    never = {"sequence": [{"wait_for": {"node": "/nobody"}}]}
    with pytest.raises(AgentRefused, match=r"bringUp\.sequence\[0\]\.wait_for: node /nobody is not there within"):
        await link.procedure(never, 3.0, name="bringUp")


async def test_an_invalid_tree_is_refused_before_any_step(robot: Pod, links):
    link = await connected(robot, links)
    with pytest.raises(AgentRefused, match=r"bringUp\.set_lifecycel: unknown key 'set_lifecycel', did you mean"):
        await link.procedure({"set_lifecycel": {}}, 3.0, name="bringUp")
    with pytest.raises(AgentRefused, match="within -1: expected a number of seconds"):
        await link.procedure(ACTIVATE, -1, name="bringUp")


async def test_a_newer_procedure_replaces_the_running_one(robot: Pod, links):
    link = await connected(robot, links)
    waiting = asyncio.create_task(
        link.procedure({"wait_for": {"node": "/nobody"}}, 60.0, name="initialization", brought="init:1")
    )
    await link.wait_for(lambda s: s.procedure == "initialization", WITHIN)
    localize(robot)

    await link.procedure(ACTIVATE, WITHIN, name="recovery", brought="up:1")

    with pytest.raises(AgentRefused, match="initialization gave way to another procedure"):
        await waiting
    assert (await status_of(link)).initialized == "up:1"


async def test_the_end_of_its_session_ends_a_procedure(robot: Pod, links):
    link = await connected(robot, links)
    waiting = asyncio.create_task(link.procedure({"wait_for": {"node": "/nobody"}}, 60.0, name="bringUp"))
    await link.wait_for(lambda s: s.procedure == "bringUp", WITHIN)
    await link.close()
    links.append(other := robot.link())
    await other.wait_for(lambda s: s.procedure == "", WITHIN)
    waiting.cancel()


async def test_a_check_is_evaluated_repeatedly(robot: Pod, links):
    node = localize(robot)
    link = await connected(robot, links, standby={"brought": "", "check": CHECK, "period": 0.1})
    status = await link.wait_for(lambda s: "is unconfigured, not active" in s.reason, WITHIN)
    assert_golden("agent", status.check, "readinessCheck.lifecycle_is", "/localizer", "unconfigured")
    await link.procedure(ACTIVATE, WITHIN, name="initialization")
    assert (await link.wait_for(lambda s: s.ready, WITHIN)).check == ""
    robot.kill(node)
    lost = await link.wait_for(lambda s: not s.ready, WITHIN)
    assert "/localizer" in lost.check
    assert (await robot.page("/ready"))[0] == 503


async def test_a_check_may_use_topics_that_the_health_tree_does_not_use(robot: Pod, links):
    check = {"topic": {"name": "/chatter", "type": "std_msgs/msg/String", "gap": "1s"}}
    link = await connected(robot, links, standby={"check": check, "period": 0.1})
    await link.wait_for(lambda s: "waiting for the first /chatter" in s.check, WITHIN)
    run(robot, "talk", "/chatter", "20")
    await link.wait_for(lambda s: s.ready, WITHIN)


async def test_managed_processes_are_up_with_their_first_node(robot: Pod, links):
    link = await connected(robot, links, managed=True)
    assert (await status_of(link)).process_up_at is None
    localize(robot)
    status = await link.wait_for(lambda s: s.process_up_at is not None, WITHIN)
    assert not status.ready, "its outputs come later, by a procedure"


async def test_a_held_pod_refuses_procedures(pod: Pod, links):
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(WITHIN)
    with pytest.raises(AgentRefused, match="the containers of pod pool-abcde are held: no workload has claimed it yet"):
        await link.procedure(ACTIVATE, 3.0, name="bringUp")


async def test_the_request_to_resend_goals_is_sent_to_connected_clients_and_awaited(robot: Pod, links):
    asked: list[int] = []
    links.append(link := robot.link(on_event=lambda _, event: asked.append(event["resendGoals"])))
    await link.wait_connected(WITHIN)
    await link.configure(TREE, OUTPUTS, 20.0)
    running = asyncio.create_task(link.procedure({"resend_goals": {}}, WITHIN, name="recovery"))
    await eventually(lambda: asked, WITHIN)
    assert not running.done()
    await link.request("resent", {"number": asked[0]})
    await running
