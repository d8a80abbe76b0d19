"""Commands of a monitor that was replaced: an agent refuses what was decided at an older epoch of the gate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from tests.support.agents import status_of
from tests.unit.agent.conftest import Pod
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.kube.agent_client import AgentLink, AgentRefused

WORKLOAD_UID = "5d0e8f0c-0a3e-4d8e-8f5b-4d8f2ad1f1b7"
CONFIGURATION: Mapping[str, Any] = {
    "tree": {"topic": {"name": "/x", "type": "std_msgs/msg/Empty", "gap": "1s"}},
    "outputs": [],
    "grace": 1.0,
}


def at(number: int, uid: str = WORKLOAD_UID) -> GateEpoch:
    return GateEpoch(uid, number)


@pytest.fixture
def running(pod: Pod) -> Pod:
    """A pod whose processes start with it, as those of a workload's own pods do."""
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot"}
    pod.start_agent()
    return pod


async def connected(pod: Pod, links: list[AgentLink]) -> AgentLink:
    links.append(link := pod.link(claim=""))
    await link.wait_connected(60)
    return link


async def test_a_command_of_an_older_epoch_is_refused(running: Pod, links: list[AgentLink]) -> None:
    former, successor = await connected(running, links), await connected(running, links)
    await former.request("configure", CONFIGURATION, epoch=at(6))
    await successor.request("configure", CONFIGURATION, epoch=at(7))
    for op in ("configure", "procedure", "restore", "probe", "give_way"):
        with pytest.raises(AgentRefused, match=r"epoch 6 of the gate.*knows epoch 7"):
            await former.request(op, CONFIGURATION, epoch=at(6))
    assert (await status_of(former)).configured, "reading is not commanding"
    await former.request("configure", CONFIGURATION, epoch=at(7))


async def test_the_newest_epoch_outlives_the_agent(running: Pod, links: list[AgentLink]) -> None:
    link = await connected(running, links)
    await link.request("configure", CONFIGURATION, epoch=at(7))
    assert running.agent is not None
    running.kill(running.agent)
    running.start_agent()
    again = await connected(running, links)
    with pytest.raises(AgentRefused, match="knows epoch 7"):
        await again.request("configure", CONFIGURATION, epoch=at(6))


async def test_a_monitor_that_sends_no_epoch_is_refused_once_one_is_known(running: Pod, links: list[AgentLink]) -> None:
    link = await connected(running, links)
    await link.request("configure", CONFIGURATION)
    await link.request("configure", CONFIGURATION, epoch=at(1))
    with pytest.raises(AgentRefused, match="knows epoch 1"):
        await link.request("configure", CONFIGURATION)
    await link.request("configure", CONFIGURATION, epoch=at(5, ""))
    with pytest.raises(AgentRefused, match="knows epoch 1"):
        await link.request("configure", CONFIGURATION, epoch=at(0))


async def test_epochs_of_a_workload_that_was_created_again_begin_again(running: Pod, links: list[AgentLink]) -> None:
    link = await connected(running, links)
    await link.request("configure", CONFIGURATION, epoch=at(7))
    await link.request("configure", CONFIGURATION, epoch=at(1, "another"))
    with pytest.raises(AgentRefused, match="knows epoch 1"):
        await link.request("configure", CONFIGURATION, epoch=at(0, "another"))


async def test_workloads_that_have_not_claimed_a_pod_leave_no_epoch(pod: Pod, links: list[AgentLink]) -> None:
    pod.start_agent()
    links.extend([other := pod.link("other", "uid2/9"), link := pod.link()])
    for one in links:
        await one.wait_connected(60)
    await other.request("configure", CONFIGURATION, epoch=at(9, "other"))
    await link.request("start", {"environment": {}, "ros": {}}, epoch=at(2))
    with pytest.raises(AgentRefused, match="knows epoch 2"):
        await link.request("configure", CONFIGURATION, epoch=at(1))
