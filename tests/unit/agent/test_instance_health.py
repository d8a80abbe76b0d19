"""The agent judges real ROS 2 processes that were held and started, or run beside it."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.agents import status_of
from tests.support.golden import assert_golden
from tests.support.network_namespaces import network
from tests.unit.agent.conftest import Pod, eventually
from understudy.api.protocol.agent_messages import AgentStatus

pytestmark = pytest.mark.ros

NODES = str(Path(__file__).parent / "nodes.py")
TALK = [sys.executable, NODES, "talk", "/cmd_vel", "20"]
OUTPUTS = [{"topic": "/cmd_vel", "type": "std_msgs/msg/String"}]
TREE = {"topic": {"name": "/cmd_vel", "gap": "300ms"}}


def runs(status: AgentStatus) -> bool:
    return status.phase == "Running" and status.ready


def ups(pod: Pod) -> list[float]:
    """When the application said that it was up."""
    return [float(line.split()[1]) for line in pod.output().splitlines() if line.startswith("up ")]


async def test_a_held_talker_is_started_and_becomes_ready(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.configure(TREE, OUTPUTS, 20.0)
    assert (await status_of(link)).configured
    started_at = time.time()
    await link.start({}, ros)
    up = await link.wait_for(lambda s: s.process_up_at is not None, 60)
    ready = await link.wait_for(runs, 60)
    assert (await pod.page("/ready"))[0] == 200
    assert started_at < ready.started_at < up.process_up_at <= ready.ready_at
    # Whichever of the two was last in the graph, the agent reports it immediately.
    assert up.process_up_at - ups(pod)[0] < 2.0
    assert ready.ready_at - up.process_up_at < 1.0
    assert (ready.phase, ready.reason) == ("Running", "")
    counted = await link.wait_for(lambda s: s.outputs["/cmd_vel"].count > 20, 60)
    assert counted.outputs["/cmd_vel"].last == pytest.approx(time.time(), abs=1.5)


async def test_a_held_agent_has_imported_ros_before_it_is_claimed(pod: Pod):
    pod.start_agent()
    await eventually(lambda: "librcl.so" in Path(f"/proc/{pod.agent.pid}/maps").read_text(), 60)


async def test_a_crashed_application_is_not_ready_until_it_runs_again(pod: Pod, links, ros):
    pod.start_agent()
    container = pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.configure(TREE, OUTPUTS, 20.0)
    await link.start({}, ros)
    first = (await link.wait_for(runs, 30)).ready_at
    pod.kill(container)
    died = time.time()
    failed = await link.wait_for(lambda s: not s.ready, 60)
    assert time.time() - died < 0.6
    assert failed.reason == "no /cmd_vel for 300 ms"
    assert (await pod.page("/ready")) == (503, "Running: no /cmd_vel for 300 ms\n")
    pod.start_container(TALK)
    back = await link.wait_for(lambda s: s.ready, 60)
    assert back.ready_at == first


async def test_a_killed_agent_finds_the_running_instance(pod: Pod, links, ros):
    agent = pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.configure(TREE, OUTPUTS, 20.0)
    await link.start({}, ros)
    before = await link.wait_for(runs, 60)
    pod.kill(agent)
    await eventually(lambda: not link.connected)
    pod.start_agent()
    # With no monitor to configure it again, as while that one is down.
    await link.close()
    await eventually(lambda: is_ready(pod), 60)
    links.append(again := pod.link())
    after = await again.wait_for(lambda s: s.ready, 60)
    assert (after.started_at, after.process_up_at, after.ready_at) == (
        before.started_at,
        before.process_up_at,
        before.ready_at,
    )


async def is_ready(pod: Pod) -> bool:
    return (await pod.page("/ready"))[0] == 200


async def test_an_instance_that_is_not_held_is_judged_from_its_start(pod: Pod, links, ros, monkeypatch):
    for key, value in ros.items():
        monkeypatch.setenv(key, value)
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot"}
    pod.start_agent()
    links.append(link := pod.link(claim=""))
    await link.wait_for(lambda s: s.reason == "waiting for the monitor's health tree", 60)
    await link.configure({"parallel": [TREE, {"topic": {"name": "/scan", "gap": "1s"}}]}, OUTPUTS, 0.5)
    await link.wait_for(lambda s: s.reason == "nothing in this pod publishes or serves /cmd_vel", 60)
    (pod.volume / "env-app").touch()
    pod.start_container(TALK)
    waiting = await link.wait_for(lambda s: s.process_up_at is not None, 60)
    assert not waiting.ready
    status = await link.wait_for(lambda s: "/scan" in s.reason and "/cmd_vel" not in s.reason, 60)
    assert "type of /scan is not known" in status.reason
    (pod.volume / "env-robot").touch()
    pod.start_container([*TALK[:-2], "/scan", "20"], container="robot")
    ready = await link.wait_for(lambda s: s.ready, 60)
    assert list(ready.outputs) == ["/cmd_vel"]


async def test_a_new_tree_keeps_a_healthy_instance_ready(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container(TALK)
    healths = []
    links.append(link := pod.link(on_change=lambda link: healths.append(link.status and link.status.ready)))
    await link.wait_connected(60)
    await link.configure(TREE, OUTPUTS, 20.0)
    await link.start({}, ros)
    await link.wait_for(runs, 60)
    healths.clear()
    await link.configure({"topic": {"name": "/cmd_vel", "rate": "> 10 Hz", "window": "1s"}}, OUTPUTS, 20.0)
    await asyncio.sleep(2.5)
    assert len(healths) >= 2
    assert all(healths)
    await link.configure({"topic": {"name": "/cmd_vel", "rate": "> 40 Hz", "window": "1s"}}, OUTPUTS, 1.0)
    failed = await link.wait_for(lambda s: not s.ready, 60)
    assert failed.reason.startswith("/cmd_vel at ")


async def test_readiness_depends_on_the_contents_of_messages(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    leaf = {"topic": "/cmd_vel", "type": "std_msgs/msg/String", "holds": "data == 'x'"}
    await link.configure({"value": leaf}, OUTPUTS, 20.0)
    await link.start({}, ros)
    await link.wait_for(runs, 60)
    await link.configure({"value": {**leaf, "holds": "data == 'y'"}}, OUTPUTS, 1.0)
    status = await link.wait_for(lambda s: not s.ready, 60)
    assert_golden("agent", status.reason, "'y'", "/cmd_vel", "1 s", "'x'")


async def test_readiness_depends_on_the_publishers_of_the_instance_itself(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.configure({"publisher": {"topic": "/cmd_vel"}}, OUTPUTS, 20.0)
    await link.start({}, ros)
    ready = await link.wait_for(runs, 60)
    assert not ready.outputs, "its messages are not received for that"
    await link.configure({"publisher": {"topic": "/cmd_vel", "node": "/nobody"}}, OUTPUTS, 1.0)
    status = await link.wait_for(lambda s: not s.ready, 60)
    assert_golden("agent", status.reason, "/cmd_vel", "/nobody", "1 s", "no publisher")


async def test_readiness_depends_on_the_nodes_of_the_instance_itself(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.configure({"node": {"name": "/talker"}}, OUTPUTS, 20.0)
    await link.start({}, ros)
    await link.wait_for(runs, 60)
    await link.configure({"node": {"name": "/nobody"}}, OUTPUTS, 1.0)
    status = await link.wait_for(lambda s: not s.ready, 60)
    assert_golden("agent", status.reason, "/nobody", "1 s")


async def test_readiness_depends_on_the_state_of_the_managed_node(pod: Pod, links, ros):
    service = "/localizer/get_state"
    outputs = [{"service": service, "type": "lifecycle_msgs/srv/GetState"}]
    pod.start_agent()
    pod.start_container([sys.executable, NODES, "localize"])
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.configure({"lifecycle": {"node": "/localizer", "state": "unconfigured"}}, outputs, 20.0)
    await link.start({}, ros)
    await link.wait_for(runs, 60)
    await link.configure({"lifecycle": {"node": "/localizer"}}, outputs, 1.0)
    status = await link.wait_for(lambda s: not s.ready, 60)
    assert_golden("agent", status.reason, "/localizer", "1 s", "unconfigured")


async def test_a_served_output_counts_as_up(pod: Pod, links, ros):
    pod.start_agent()
    pod.start_container([sys.executable, NODES, "serve", "/snap"])
    pod.environment["UNDERSTUDY_HELD_CONTAINERS"] = "app"
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.configure(
        {"topic": {"name": "/cmd_vel", "gap": "300ms"}}, [{"service": "/snap", "type": "std_srvs/srv/Trigger"}], 1.0
    )
    await link.start({}, ros)
    status = await link.wait_for(lambda s: s.process_up_at is not None, 60)
    assert abs(status.process_up_at - ups(pod)[0]) < 2.0
    assert not status.ready


async def test_a_type_that_is_not_installed_is_reported(pod: Pod, links, ros, monkeypatch):
    for key, value in ros.items():
        monkeypatch.setenv(key, value)
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot"}
    pod.start_agent()
    (pod.volume / "env-app").touch()
    pod.start_container(TALK)
    links.append(link := pod.link(claim=""))
    await link.wait_connected(60)
    tree = {"parallel": [TREE, {"topic": {"name": "/bumper", "type": "robots_msgs/msg/Bumper", "gap": "1s"}}]}
    await link.configure(tree, OUTPUTS, 20.0)
    status = await link.wait_for(lambda s: "robots_msgs" in s.reason, 60)
    assert "is not installed" in status.reason


@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
async def test_outputs_count_from_this_pod_and_inputs_from_the_robot(pod: Pod, ros, monkeypatch):
    """Three hosts: this pod, another instance of the workload that leaked through, the robot."""
    del ros["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    for key, value in ros.items():
        monkeypatch.setenv(key, value)
    tree = {"parallel": [TREE, {"topic": {"name": "/scan", "type": "std_msgs/msg/String", "gap": "1s"}}]}
    configuration = {"tree": tree, "outputs": OUTPUTS, "grace": 60.0}
    (pod.memory / "agent.json").write_text(json.dumps({"configuration": configuration}))
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot"}
    with network() as lan:
        own, other, robot = lan.host("10.77.0.2"), lan.host("10.77.0.3"), lan.host("10.77.100.1")

        async def says(text: str) -> bool:
            return text in (await asyncio.to_thread(ready))

        def ready() -> str:
            command = ["python3", "-c", FETCH, str(pod.health_port)]
            return subprocess.run([*own, *command], capture_output=True, text=True).stdout

        pod.start_agent(inside=own)
        for host, topic, name in ((other, "/cmd_vel", "other"), (robot, "/scan", "robot")):
            (pod.volume / f"env-{name}").touch()
            pod.start_container([*TALK[:-2], topic, "20"], container=name, inside=host)
        await eventually(lambda: pod.output("other").startswith("up") and pod.output("robot").startswith("up"), 60)
        await eventually(lambda: says("nothing in this pod publishes or serves /cmd_vel"), 60)
        await asyncio.sleep(2)
        assert await says("nothing in this pod publishes or serves /cmd_vel")
        (pod.volume / "env-app").touch()
        app = pod.start_container(TALK, inside=own)
        await eventually(lambda: says("200 ready"), 60)
        pod.kill(app)
        # The other instance's commands go on.
        await eventually(lambda: says("503 Running: no /cmd_vel for 300 ms"), 60)


SERVER = Path(sys.executable).parent / "fast-discovery-server"


@pytest.fixture
def discovery_server(pod: Pod) -> Iterator[str]:
    """Its address."""
    if not SERVER.exists():
        pytest.skip("there is no fast-discovery-server")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    with (pod.folder / "server.log").open("wb") as log:
        server = subprocess.Popen([SERVER, "-i", "0", "-l", "127.0.0.1", "-p", str(port)], stdout=log, stderr=log)
    yield f"127.0.0.1:{port}"
    server.kill()
    server.wait()


async def test_an_agent_behind_a_discovery_server_finds_its_instance(pod: Pod, links, ros, discovery_server):
    pod.start_agent()
    pod.start_container(TALK)
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.configure(TREE, OUTPUTS, 20.0)
    await link.start({}, {**ros, "ROS_DISCOVERY_SERVER": discovery_server})
    await link.wait_for(runs, 120)


FETCH = """
import sys, urllib.error, urllib.request
try:
    answer = urllib.request.urlopen(f"http://127.0.0.1:{sys.argv[1]}/ready")
except urllib.error.HTTPError as error:
    answer = error
except OSError:
    sys.exit()
print(answer.status, answer.read().decode())
"""
