"""The task proxy as a process, with two pods: each an application and its agent, isolated by their partitions.

The client, the applications, the agents and the proxy are real processes; the monitor's part, to say who is in control,
is played here over the proxy's socket.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.agents import PRIVATE_KEY
from tests.unit.action_proxy.conftest import ACTION, CANCELED, SUCCEEDED, TYPE, Process, eventually
from tests.unit.agent.conftest import PACKAGE, TOKEN
from tests.unit.agent.conftest import Pod as AgentPod
from understudy.action_proxy import process as running
from understudy.action_proxy import succession
from understudy.action_proxy.control_state import ControlState, Peer, TaskRule
from understudy.api.kinds.task_spec import Task
from understudy.ros.dds.profiles import instance_profiles_xml
from understudy.ros.runtime.served_node import ServedNode

pytestmark = pytest.mark.ros

TREE = {"topic": {"name": "/cmd_vel", "type": "std_msgs/msg/String", "gap": "300ms"}}
OUTPUTS = [{"topic": "/cmd_vel", "type": "std_msgs/msg/String"}]


class Pod:
    """One instance."""

    def __init__(self, name: str, folder: Path, start: Callable[..., Process], profiles: Path) -> None:
        folder.mkdir()
        self.name, self.uid, self.inner = name, name.ljust(36, "-"), AgentPod(folder)
        self._start = start
        self._environment = {
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(profiles),
            "UNDERSTUDY_POD": name,
            "UNDERSTUDY_POD_UID": name.ljust(36, "-"),
        }
        # Judged by nothing: these tests are about goals.
        configuration = {"tree": TREE, "outputs": OUTPUTS, "grace": 60.0}
        (self.inner.memory / "agent.json").write_text(json.dumps({"configuration": configuration}))
        self.inner.environment = {"UNDERSTUDY_WORKLOAD": "robot", **self._environment}
        self.agent: subprocess.Popen[bytes] | None = None
        self.application: Process

    def start(self, role: str = "serve", **environment: str) -> Pod:
        self.agent = self.inner.start_agent()
        self.application = self._start(role, ACTION, **self._environment, **environment)
        return self

    def kill(self) -> None:
        """The whole pod is gone."""
        self.application.kill()
        self.inner.end()

    def peer(self, **more: Any) -> Peer:
        return Peer(
            self.uid, self.name, "127.0.0.1", self.inner.port, TOKEN.decode(), "", **{"key": PRIVATE_KEY.hex(), **more}
        )


class Monitor:
    """The proxy's process, and the monitor's end of its socket."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir()
        with socket.socket() as found:
            found.bind(("127.0.0.1", 0))
            self.port: int = found.getsockname()[1]
        self.reports: list[dict[str, Any]] = []
        self.epoch, self.active, self.settled = 0, "", True
        self.rules = (TaskRule(ACTION, TYPE),)
        self.peers: tuple[Peer, ...] = ()
        self.proxy: subprocess.Popen[bytes]
        self._reading: asyncio.Task[None] | None = None
        self._writer: asyncio.StreamWriter

    async def start(self) -> None:
        path = self._folder / "tasks.sock"
        self._run(path)

        async def connect() -> None:
            while True:
                try:
                    reader, self._writer = await asyncio.open_unix_connection(path)
                    break
                except OSError:
                    await asyncio.sleep(0.05)
            self._reading = asyncio.create_task(self._read(reader))

        async with asyncio.timeout(60):
            await connect()
        self.tell()

    async def healthy(self) -> bool:
        """Returns whether the kubelet's probe succeeds."""
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        except ConnectionRefusedError:
            return False
        writer.write(b"GET /healthz HTTP/1.1\r\n\r\n")
        status = (await reader.readline()).split()[1]
        writer.close()
        return status == b"200"

    def _run(self, path: Path) -> None:
        environment = {
            **os.environ,
            "PYTHONPATH": str(PACKAGE),
            "UNDERSTUDY_WORKLOAD": "robot",
            "UNDERSTUDY_STATE": str(self._folder),
            "UNDERSTUDY_TASKS_SOCKET": str(path),
            "UNDERSTUDY_TASKS_PORT": str(self.port),
        }
        with (self._folder / "proxy.log").open("ab") as log:
            command = [sys.executable, "-m", "understudy.main", "tasks"]
            self.proxy = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            self.reports.append(json.loads(line)["report"])

    def tell(self, *, pod_deleted: bool = False) -> None:
        situation = ControlState(
            "robot", self.epoch, self.active, self.settled, self.rules, self.peers, pod_deleted=pod_deleted
        )
        self._writer.write(json.dumps({"situation": situation.to_wire()}).encode() + b"\n")

    def switch(self, pod: Pod | None, *peers: Peer, settled: bool = True) -> None:
        self.epoch += 1
        self.active, self.settled = pod.uid if pod else "", settled
        self.peers = peers
        self.tell()

    def task(self) -> dict[str, Any]:
        return self.reports[-1]["tasks"][0] if self.reports and self.reports[-1]["tasks"] else {}

    def kill(self, *, journal: bool = True) -> None:
        self.proxy.kill()
        self.proxy.wait()
        if not journal:
            for folder in (running.OWN, running.LASTING):
                (self._folder / folder / "goals.json").unlink()

    def close(self) -> None:
        self.kill()
        if self._reading is not None:
            self._reading.cancel()

    def log(self) -> str:
        return (self._folder / "proxy.log").read_text()


@pytest.fixture
async def monitor(dds, tmp_path: Path):
    made = Monitor(tmp_path / "monitor")
    await made.start()
    yield made
    made.close()
    print(made.log())


@pytest.fixture
def pods(dds, tmp_path: Path, start):
    profiles = tmp_path / "profiles.xml"
    profiles.write_text(instance_profiles_xml([Task(action=ACTION, type=TYPE)]))
    made: list[Pod] = []

    def pod(name: str, *arguments: str, **environment: str) -> Pod:
        made.append(Pod(name, tmp_path / name, start, profiles).start(*arguments, **environment))
        return made[-1]

    yield pod
    for one in made:
        one.kill()
        print((one.inner.folder / "agent.log").read_text())


def executed(pod: Pod) -> list[int]:
    return [line["order"] for line in pod.application.events_of("executing")]


async def test_a_client_sees_one_goal_although_another_instance_takes_over(monitor, pods, start):
    first, second = pods("robot-1", STEP="0.1"), pods("robot-2", STEP="0.1")
    monitor.switch(first, first.peer(), second.peer())
    client = start("client", ACTION, "100", "500")
    await eventually(lambda: client.events_of("feedback", index=0, step=10))
    assert client.events_of("answered", accepted=True)
    goal = client.events_of("answered", index=0)[0]["goal"]
    assert first.application.events_of("executing", goal=goal), "the client's own id"
    assert second.application.events_of("executing") == []
    first.kill()
    monitor.switch(None, second.peer(), settled=False)
    late = start("client", ACTION, "3")
    await eventually(lambda: late.events_of("ready"))
    assert client.events_of("ended", index=0) == []
    monitor.switch(second, second.peer(), settled=False)
    monitor.settled = True
    monitor.tell()
    await eventually(lambda: client.events_of("ended", index=0, status=SUCCEEDED), 120)
    assert second.application.events_of("executing", goal=goal)
    assert len(client.events_of("answered", index=0)) == 1
    steps = [line["step"] for line in client.events_of("feedback", index=0)]
    # A client that is starved may miss some, as with every publisher; they never come twice or in another order.
    again = [i for i in range(1, len(steps)) if steps[i] <= steps[i - 1]]
    assert len(again) == 1, "first those of the one instance, then those of the other"
    assert len(steps[again[0] :]) > 20
    assert len(client.events_of("ended", index=0)[0]["result"]) == 102
    await eventually(lambda: late.events_of("ended", status=SUCCEEDED))
    await eventually(lambda: monitor.task().get("resent") == 1 and monitor.task()["active"] == 0)


@pytest.mark.parametrize("journal", [True, False], ids=["restarted", "without its journal"])
async def test_the_proxy_is_killed_and_no_client_notices(monitor, pods, start, journal):
    pod = pods("robot-1", STEP="0.1")
    monitor.switch(pod, pod.peer())
    client = start("client", ACTION, "60", "61")
    await eventually(lambda: client.events_of("feedback", index=1, step=3))
    asked = len(monitor.reports)
    monitor.kill(journal=journal)
    await monitor.start()
    await eventually(lambda: client.events_of("ended", index=0) and client.events_of("ended", index=1), 120)
    assert [line["status"] for line in client.events_of("ended")] == [SUCCEEDED, SUCCEEDED]
    assert sorted(executed(pod)) == [60, 61], "each was executed once"
    assert len(monitor.reports) > asked
    after = start("client", ACTION, "2")
    await eventually(lambda: after.events_of("ended", status=SUCCEEDED))


async def test_a_proxy_ends_that_the_one_of_a_newer_pod_replaces_and_serves_again_once_that_one_is_gone(
    monitor, pods, start, tmp_path
):
    pod = pods("robot-1", STEP="0.1")
    monitor.switch(pod, pod.peer())
    client = start("client", ACTION, "100")
    await eventually(lambda: client.events_of("feedback", step=3))
    successor = Monitor(tmp_path / "successor")
    try:
        await successor.start()
        successor.switch(pod, pod.peer())
        await eventually(lambda: monitor.proxy.poll() == 0)
        assert successor.proxy.poll() is None
        await monitor.start()  # as Kubernetes restarts the container
        await eventually(lambda: "this one waits until it is gone" in monitor.log())
        await eventually(lambda: client.events_of("ended", status=SUCCEEDED))
        assert executed(pod) == [100]
        assert not monitor.task(), "it serves nothing"
    finally:
        successor.close()
        print(successor.log())
    await eventually(lambda: monitor.task().get("served"))
    later = start("client", ACTION, "2")
    await eventually(lambda: later.events_of("ended", status=SUCCEEDED))


async def test_a_proxy_whose_pod_was_deleted_ends_and_does_not_serve_again(monitor, pods):
    pod = pods("robot-1")
    monitor.switch(pod, pod.peer())
    await eventually(lambda: monitor.task().get("served"))
    monitor.tell(pod_deleted=True)
    await eventually(lambda: monitor.proxy.poll() == 0)
    monitor.reports.clear()
    await monitor.start()  # as the kubelet does that does not know of it yet
    monitor.tell(pod_deleted=True)
    await asyncio.sleep(succession.GONE_AFTER + 1)
    assert not monitor.task(), "it serves nothing"


async def test_goals_are_cancelled_rejected_preempted_and_survive_their_client(monitor, pods, start):
    pod, spare = pods("robot-1", "preempt"), pods("robot-2")
    monitor.switch(pod, pod.peer(), spare.peer())
    client = start("client", ACTION, "400", "2000", "401", ONE_BY_ONE="1")
    await eventually(lambda: len(client.events_of("answered")) == 3)
    assert [line["accepted"] for line in sorted(client.events_of("answered"), key=lambda line: line["index"])] == [
        True,
        False,
        True,
    ]
    # The server replaced the older goal by the newer one. The older goal's client is informed, and no switch sends that goal again.
    await eventually(lambda: client.events_of("ended", index=0, status=6))
    client.tell("cancel 2")
    await eventually(lambda: client.events_of("ended", index=2, status=CANCELED))
    assert client.events_of("canceling", index=2, code=0, goals=1)
    gone = start("client", ACTION, "402")
    await eventually(lambda: gone.events_of("feedback"))
    gone.kill()
    monitor.switch(spare, pod.peer(), spare.peer())
    await eventually(lambda: executed(spare) == [402])
    await eventually(lambda: pod.application.events_of("canceled") and len(pod.application.events_of("canceled")) == 2)


async def test_an_executing_standby_has_the_goal_already(monitor, pods, start):
    first, second = pods("robot-1", STEP="0.1"), pods("robot-2", STEP="0.1")
    monitor.switch(first, first.peer(), second.peer(executing=True))
    client = start("client", ACTION, "40")
    await eventually(lambda: executed(second) == [40])
    await eventually(lambda: client.events_of("feedback", step=5))
    first.kill()
    monitor.switch(second, second.peer())
    await eventually(lambda: client.events_of("ended", status=SUCCEEDED), 120)
    assert executed(second) == [40], "it went on, and wasn't begun again"
    assert client.events_of("answered", accepted=True)


async def test_the_liveness_probe_fails_if_the_proxy_hangs(monitor):
    end = time.monotonic() + 60
    while not await monitor.healthy():
        assert time.monotonic() < end
        await asyncio.sleep(0.1)
    assert running.health(running.HUNG)[0] == 200
    assert running.health(running.HUNG + 1)[0] == 503


async def test_a_hanging_thread_is_detected(dds):
    served, release = ServedNode("hanging"), threading.Event()
    try:
        await eventually(lambda: served.silent_for < 1.5)
        served.do(lambda: release.wait(60))
        await eventually(lambda: served.silent_for > 3)  # at rest it comes round every second
        release.set()
        await eventually(lambda: served.silent_for < 1.5)
    finally:
        release.set()
        await served.close()


async def test_a_type_that_is_not_installed_is_reported(monitor):
    monitor.rules = (TaskRule("/dock", "robots_msgs/action/Dock"),)
    monitor.tell()
    await eventually(lambda: "robots_msgs/action/Dock is not installed" in monitor.task().get("message", ""))
    assert not monitor.task()["served"]
