"""What an application can do to its agent through the volume that they share: nothing."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.unit.agent.conftest import Pod, eventually
from understudy.agent.agent import Agent
from understudy.agent.agent_memory import NAME, AgentMemory
from understudy.agent.pod_identity import PodIdentity
from understudy.api import names
from understudy.api.protocol import freeze_script
from understudy.kube.gates.probes import ProbeSender
from understudy.ros.rmw import MIDDLEWARE

READ_ONLY = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
_MOUNT = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"'
ROS = {"ROS_DOMAIN_ID": "77", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
HOSTILE = {"LD_LIBRARY_PATH": "/understudy", "LD_PRELOAD": "/understudy/x.so", "PYTHONPATH": "/understudy"}


def read_only(folder: Path) -> list[str]:
    """A command prefix for a process that cannot write to a folder, as with a read-only mount of a container."""
    if subprocess.run(
        [*READ_ONLY, _MOUNT, str(folder), "true"], capture_output=True, check=False, timeout=20
    ).returncode:
        pytest.skip("mount namespaces are not available")
    return [*READ_ONLY, _MOUNT, str(folder)]


async def test_a_held_container_waits_and_starts_without_writing_to_the_volume(pod: Pod, links) -> None:
    pod.start_agent()
    remove = f"rm -f {pod.volume}/{freeze_script.HELD_NAME} {pod.volume}/{NAME}; echo $GREETING; exec sleep 60"
    (pod.volume / freeze_script.HELD_NAME).touch()
    pod.start_container(["sh", "-c", remove], inside=read_only(pod.volume))
    links.append(link := pod.link())
    assert (await link.wait_for(lambda s: s.ready, 60)).phase == "Held"
    await link.start({"app": {"GREETING": "hello"}}, ROS)
    await eventually(lambda: pod.output().endswith("hello\n"))
    assert (pod.volume / freeze_script.HELD_NAME).exists(), "the application cannot let itself continue"


async def test_an_agent_does_not_read_its_memory_from_the_shared_volume(pod: Pod, links) -> None:
    pod.start_container(["sleep", "60"])
    agent = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({}, ROS)
    started = await link.wait_for(lambda s: s.phase == "Starting", 60)
    assert not (pod.volume / NAME).exists()
    (pod.volume / NAME).write_text(json.dumps({"workload": "thief", "claim": "uid/9", "ros": HOSTILE}))
    pod.kill(agent)
    pod.start_agent()
    status = await link.wait_for(lambda s: s.started_at is not None, 60)
    assert status.started_at == pytest.approx(started.started_at, abs=0.01), "and its own outlives a restart"
    links.append(thief := pod.link("thief", "uid/9"))
    await eventually(lambda: "claimed by robot" in thief.problem)


async def test_an_agent_in_a_pod_of_an_older_operator_has_its_memory_in_the_shared_volume(pod: Pod, links) -> None:
    pod.environment[names.MEMORY_VARIABLE] = str(pod.volume)
    pod.start_container(["sleep", "60"])
    agent = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({}, ROS)
    pod.kill(agent)
    pod.start_agent()
    await link.wait_for(lambda s: s.phase == "Starting", 60)
    assert json.loads((pod.volume / NAME).read_text())["workload"] == "robot"


def test_without_a_volume_of_its_own_an_agent_uses_the_shared_one() -> None:
    environment = {"UNDERSTUDY_POD": "p", "UNDERSTUDY_POD_UID": "u", "UNDERSTUDY_WORKLOAD": "w"}
    assert PodIdentity.from_environment(environment).memory == Path(names.AGENT_DIR)
    own = PodIdentity.from_environment({**environment, names.MEMORY_VARIABLE: names.MEMORY_DIR})
    assert (own.directory, own.memory) == (Path(names.AGENT_DIR), Path(names.MEMORY_DIR))


async def test_only_variables_of_the_ros_graph_enter_the_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*ROS, *HOSTILE]:
        monkeypatch.delenv(name, raising=False)
    AgentMemory(workload="robot", claim="uid/1", ros={**ROS, **HOSTILE}).save(tmp_path)
    held = PodIdentity("", "pool-abcde", "uid", ("app",), tmp_path, tmp_path, tmp_path / "token")
    agent = Agent(held, ProbeSender("0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"))
    await agent.begin()
    try:
        assert os.environ["ROS_DOMAIN_ID"] == "77"
        assert not HOSTILE.keys() & os.environ.keys()
    finally:
        await agent.end()
        for name in ROS:
            os.environ.pop(name, None)


async def test_other_variables_of_the_ros_graph_do_not_reach_the_application(pod: Pod, links) -> None:
    pod.start_container(["sh", "-c", 'echo "$ROS_DOMAIN_ID$LD_PRELOAD $LD_LIBRARY_PATH"; exec sleep 60'])
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({"app": {"LD_LIBRARY_PATH": "/opt/own"}}, {**ROS, **HOSTILE})
    await eventually(lambda: pod.output() == "77 /opt/own\n")


@pytest.mark.parametrize(
    "discovery", [{"mode": "Managed"}, {"mode": "External", "server": "10.0.0.1:11811"}, {"mode": "Multicast"}]
)
def test_the_operator_sends_no_other_variables(discovery: dict[str, str]) -> None:
    from understudy.api.kinds.robot_workload import Ros

    ros = Ros.model_validate({"domainId": 5, "discovery": discovery})
    found = MIDDLEWARE.introspecting(MIDDLEWARE.environment(ros, "10.0.0.9"))
    assert found.keys() | {MIDDLEWARE.settings_variable} <= MIDDLEWARE.variables
