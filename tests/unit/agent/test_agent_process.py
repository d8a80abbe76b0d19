"""A real agent process, really held shells and a real client over the loopback; no ROS."""

import asyncio
import json
import signal
import stat
import time
from dataclasses import dataclass

import pytest

from tests.support.agents import status_of
from tests.unit.agent.conftest import UID, Pod, eventually
from understudy.agent import process as running
from understudy.agent.held_containers import HeldContainers
from understudy.kube.agent_client import AgentGone, AgentRefused
from understudy.kube.gates.probes import ProbeKeys, ProbeReceiver, ProbeSender

SAY = ["sh", "-c", 'echo "domain $ROS_DOMAIN_ID, $GREETING"; exec sleep 60']
XML = '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/x" gap="1s"/></BehaviorTree></root>'
ROS = {"ROS_DOMAIN_ID": "77", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


async def test_a_held_container_is_started_with_the_robots_settings(pod: Pod, links):
    pod.start_agent()
    pod.start_container(SAY)
    links.append(link := pod.link())
    await link.wait_connected(60)
    held = await link.wait_for(lambda s: s.ready, 60)
    assert (held.phase, held.started_at, held.configured) == ("Held", None, False)
    await link.start({"app": {"GREETING": "it's me"}}, ROS)
    status = await link.wait_for(lambda s: s.phase == "Starting", 60)
    assert not status.ready
    assert status.started_at is not None
    await eventually(lambda: pod.output() == "domain 77, it's me\n")


async def test_several_containers_each_get_their_own(pod: Pod, links):
    pod.environment["UNDERSTUDY_HELD_CONTAINERS"] = "app driver"
    pod.start_agent()
    pod.start_container(SAY)
    links.append(link := pod.link())
    await link.wait_connected(60)
    assert link.status is not None
    assert link.status.reason == "not waiting (yet): app, driver" or "driver" in link.status.reason
    pod.start_container(SAY, container="driver")
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({"app": {"GREETING": "a"}, "driver": {"GREETING": "b", "ROS_DOMAIN_ID": "5"}}, ROS)
    await eventually(lambda: pod.output() == "domain 77, a\n")
    await eventually(lambda: pod.output("driver") == "domain 5, b\n")


async def test_readiness_follows_the_held_containers(pod: Pod):
    pod.start_agent()
    assert (await eventually(lambda: pod.page("/healthz")))[0] in (0, 200)
    await eventually(lambda: _is(pod, 503))
    container = pod.start_container(SAY)
    await eventually(lambda: _is(pod, 200))
    pod.kill(container)
    await eventually(lambda: _is(pod, 503))
    pod.start_container(SAY)
    await eventually(lambda: _is(pod, 200))
    assert (await pod.page("/nothing"))[0] == 404


async def _is(pod: Pod, status: int) -> bool:
    return (await pod.page("/ready"))[0] == status


async def test_a_wrong_token_is_refused(pod: Pod, links):
    pod.start_agent()
    links.append(right := pod.link())
    await right.wait_connected(60)
    links.append(wrong := pod.link(token=b"guess"))
    with pytest.raises(AgentGone, match="authentication failed"):
        await wrong.wait_connected(1)
    with pytest.raises(AgentGone, match="authentication failed"):
        await wrong.start({}, {})


async def _connection(pod: Pod):
    async def connect():
        try:
            return await asyncio.open_connection("127.0.0.1", pod.port)
        except OSError:
            return None

    return await eventually(connect)


@pytest.mark.parametrize(
    "data",
    [
        b"\n",
        b"[]\n",
        b"{}\n",
        b'{"mac": "\xff"}\n',
        b'{"mac": 5}\n',
        b'{"mac": "\\u00fc"}\n',
        b'{"mac": "\\ud800", "workload": "\\ud800"}\n',
        b'{"version": 2, "mac": "\\ud800", "nonce": []}\n',
        b"x" * 10_000,
        b"[" * 3000 + b"\n",
    ],
)
async def test_invalid_data_ends_only_the_session(pod: Pod, links, data):
    pod.start_agent()
    reader, writer = await _connection(pod)
    await reader.readline()
    writer.write(data)
    async with asyncio.timeout(5):
        while await reader.read(1000):
            pass
    writer.close()
    links.append(link := pod.link())
    await link.wait_connected(60)


async def test_an_unauthenticated_client_that_sends_nothing_is_disconnected(pod: Pod):
    pod.start_agent()
    reader, _ = await _connection(pod)
    await reader.readline()
    async with asyncio.timeout(5):
        assert await reader.read() == b""


async def test_unauthenticated_clients_do_not_block_a_monitor(pod: Pod, links):
    pod.start_agent()
    strangers = [await _connection(pod) for _ in range(60)]
    links.append(link := pod.link())
    await link.wait_connected(2)
    for _, writer in strangers:
        writer.close()


async def test_an_invalid_request_of_a_monitor_is_answered(pod: Pod, links):
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    for op, body in [
        ("dance", {}),
        ("configure", {"tree": 5, "outputs": [], "grace": 1}),
        ("configure", {"tree": {"topic": {"nam": "/x"}}, "outputs": [], "grace": 1}),
        ("configure", {"tree": XML, "outputs": [], "grace": 1}),
        ("configure", {"tree": XML[1:], "form": "xml", "outputs": [], "grace": 1}),
        ("configure", {"tree": XML, "form": "toml", "outputs": [], "grace": 1}),
        ("configure", {"tree": XML, "form": ["xml"], "outputs": [], "grace": 1}),
        ("configure", {"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": 3, "grace": 1}),
        ("configure", {"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": [{}], "grace": 1}),
        ("configure", {"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": [], "grace": "long"}),
        ("start", {"environment": [], "ros": {}}),
        ("start", {"environment": {"app": {"A": 1}}, "ros": {}}),
        ("start", {"environment": {"app": {"A=B": "1"}}, "ros": {}}),
        ("start", {"environment": {}, "ros": None}),
        ("probe", {"host": "robot.example", "port": 8149, "interval": 0.001, "duration": 1}),
        ("probe", {"host": "127.0.0.1", "port": 0, "interval": 0.001, "duration": 1}),
        ("probe", {"host": "127.0.0.1", "port": 8149, "interval": 0.000001, "duration": 1}),
        ("probe", {"host": "127.0.0.1", "port": 8149, "interval": 0.001, "duration": 1e9}),
        ("probe", {"host": "127.0.0.1", "port": 8149, "interval": "x", "duration": 1}),
    ]:
        with pytest.raises(AgentRefused, match=op):
            await link.request(op, body)
    status = await status_of(link)
    assert (status.phase, status.configured) == ("Held", False)
    assert not (pod.volume / "env-app").exists()


async def test_a_tree_in_xml_is_accepted_and_survives_a_restart(pod: Pod, links):
    first = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.configure(XML, [], 1.0, form="xml")
    assert (await status_of(link)).configured
    pod.kill(first)
    pod.start_agent()
    links.append(again := pod.link())
    await again.wait_connected(60)
    assert (await status_of(again)).configured
    assert json.loads((pod.memory / "agent.json").read_text())["configuration"]["form"] == "xml"


async def test_only_the_workload_that_started_the_pod_commands_it(pod: Pod, links):
    pod.start_agent()
    pod.start_container(SAY)
    first, second, waiting = pod.link(), pod.link("other", "uid2/9"), pod.link("robot", "uid/2")
    links.extend([first, second, waiting])
    for link in links:
        await link.wait_connected(60)
    await asyncio.gather(first.start({"app": {"GREETING": "first"}}, ROS))
    for link in (second, waiting):
        with pytest.raises((AgentRefused, AgentGone)):
            await link.start({"app": {"GREETING": "second"}}, ROS)
        await eventually(lambda link=link: "claimed by robot (uid/1)" in link.problem)
    await eventually(lambda: pod.output() == "domain 77, first\n")
    links.append(late := pod.link("other", "uid2/9"))
    with pytest.raises(AgentGone, match="claimed by robot"):
        await late.wait_connected(1)
    links.append(restarted := pod.link())
    await restarted.wait_connected(2)
    assert first.connected


async def test_one_of_two_simultaneous_starts_wins(pod: Pod, links):
    pod.start_agent()
    pod.start_container(SAY)
    links.extend(pod.link(f"robot-{i}", f"uid/{i}") for i in range(4))
    for link in links:
        await link.wait_connected(60)
    results = await asyncio.gather(
        *(link.start({"app": {"GREETING": link.workload}}, ROS) for link in links), return_exceptions=True
    )
    winners = [link.workload for link, result in zip(links, results, strict=True) if result is None]
    assert len(winners) == 1
    await eventually(lambda: pod.output() == f"domain 77, {winners[0]}\n")


async def test_a_start_can_be_repeated(pod: Pod, links):
    pod.start_agent()
    pod.start_container(SAY)
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.start({"app": {"GREETING": "once"}}, ROS)
    started_at = (await status_of(link)).started_at
    await link.start({"app": {"GREETING": "twice"}}, ROS)
    assert (await status_of(link)).started_at == started_at
    await eventually(lambda: pod.output() == "domain 77, once\n")


async def test_a_container_created_after_the_start_continues_at_once(pod: Pod, links):
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.start({"app": {"GREETING": "early"}}, ROS)
    container = pod.start_container(SAY)
    await eventually(lambda: pod.output() == "domain 77, early\n")
    pod.kill(container)
    pod.start_container(SAY)
    await eventually(lambda: pod.output() == "domain 77, early\n" * 2)


async def test_a_killed_agent_restarts_with_its_state(pod: Pod, links):
    agent = pod.start_agent()
    pod.start_container(SAY)
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({"app": {"GREETING": "kept"}}, ROS)
    started_at = (await status_of(link)).started_at
    asking = asyncio.gather(*(status_of(link) for _ in range(3)), return_exceptions=True)
    await asyncio.sleep(0)
    pod.kill(agent)
    async with asyncio.timeout(1):
        await asking
    await eventually(lambda: not link.connected, 1)
    assert link.status is None
    with pytest.raises(AgentGone):
        await status_of(link)
    assert stat.S_IMODE((pod.memory / "agent.json").stat().st_mode) == 0o600
    pod.start_agent()
    links.append(other := pod.link("other", "x/1"))
    status = await link.wait_for(lambda s: True, 60)
    assert (status.phase, status.started_at) == ("Starting", started_at)
    with pytest.raises(AgentGone, match="claimed by robot"):
        await other.wait_connected(1.5)


async def test_a_held_pods_agent_is_killed_and_the_pod_can_still_be_claimed(pod: Pod, links):
    pod.kill(pod.start_agent())
    pod.start_container(SAY)
    await asyncio.sleep(0.2)
    pod.start_agent()
    links.append(link := pod.link())
    assert (await link.wait_for(lambda s: s.ready, 10)).phase == "Held"
    await link.start({"app": {"GREETING": "late"}}, ROS)
    await eventually(lambda: pod.output() == "domain 77, late\n")


async def test_an_interrupted_start_is_completed(pod: Pod, links):
    """Killed after the claim was kept and before the process was woken."""
    agent = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    await link.start({"app": {"GREETING": "cut"}}, ROS)
    pod.kill(agent)
    (pod.volume / "env-app").unlink()
    pod.start_container(SAY)
    await eventually(lambda: not HeldContainers(pod.volume, ["app"]).missing())
    pod.start_agent()
    await eventually(lambda: pod.output() == "domain 77, cut\n")


async def test_unreadable_state_does_not_stop_an_agent(pod: Pod, links):
    (pod.memory / "agent.json").write_text("{")
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)


async def test_a_pod_that_is_not_held_belongs_to_its_workload(pod: Pod, links):
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot", **ROS}
    pod.start_agent()
    links.extend([link := pod.link(claim=""), other := pod.link("other", "")])
    status = await link.wait_for(lambda s: True, 60)
    assert status.phase == "Starting"
    with pytest.raises(AgentRefused, match="are not held"):
        await link.start({}, {})
    with pytest.raises(AgentGone, match="is an instance of robot, not of other"):
        await other.wait_connected(1)
    assert (await pod.page("/ready"))[0] == 503


async def test_the_agent_ends_on_a_signal(pod: Pod, links):
    agent = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    agent.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(agent.wait, 5) == 0


async def test_the_agent_ends_on_a_signal_while_it_judges_an_instance(pod: Pod, links):
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot", **ROS}
    agent = pod.start_agent()
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.reason.startswith("waiting for the monitor"), 60)
    agent.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(agent.wait, 5) == 0


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"UNDERSTUDY_HELD_CONTAINERS": ""}, "neither UNDERSTUDY_WORKLOAD nor UNDERSTUDY_HELD_CONTAINERS"),
        ({"UNDERSTUDY_POD_UID": "short"}, "pod UID 'short'"),
        ({"UNDERSTUDY_POD": ""}, "UNDERSTUDY_POD not set"),
    ],
)
async def test_the_agent_reports_what_is_missing_in_its_environment(pod: Pod, environment, message):
    pod.environment |= environment
    assert await asyncio.to_thread(pod.start_agent().wait, 10) == 2
    assert message in (pod.folder / "agent.log").read_text()


async def test_probes_are_sent_to_the_address_of_the_monitor(pod: Pod, links):
    receiver = ProbeReceiver(ProbeKeys())
    port = await receiver.listen(port=0, host="127.0.0.1")
    pod.start_agent()
    links.append(link := pod.link())
    await link.wait_connected(60)
    receiver.trust(UID, link.probe_key)
    await link.configure({"topic": {"name": "/x", "gap": "1s"}}, [], 1.0, probe=("127.0.0.1", port))
    first = await receiver.wait(UID, 0, 10)
    assert await receiver.wait(UID, first + 0.01, 10) - first > 0.7
    asked = time.time()
    await link.request("probe", {"host": "127.0.0.1", "port": port, "interval": 0.002, "duration": 0.5})
    await eventually(lambda: receiver.count_since(UID, asked) > 20, 60)
    assert time.time() - asked < 15, "at one a second it would take longer"
    receiver.close()


@dataclass
class Connected:
    """The monitors that are connected."""

    count: int


async def test_an_agent_without_monitors_stops_probing(monkeypatch):
    monkeypatch.setattr(running, "WITHOUT_MONITOR", 0.1)
    monkeypatch.setattr(running, "_HOUSEKEEPING", 0.02)
    probes = ProbeSender(UID)
    probes.aim("127.0.0.1", 9)
    sessions = Connected(1)
    task = asyncio.create_task(running.stop_probes_without_monitor(sessions, probes))
    await asyncio.sleep(0.2)
    probes.burst(0.001, 0.01)
    sessions.count = 0
    await asyncio.sleep(0.2)
    with pytest.raises(RuntimeError, match="no address"):
        probes.burst(0.001, 0.01)
    task.cancel()
    probes.close()
