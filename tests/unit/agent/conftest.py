"""A pod without Kubernetes: a real agent process, folders for the volumes, real held containers."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.support.agents import PUBLIC_KEY, known_to_monitor
from understudy.api import names
from understudy.api.protocol import hold_script
from understudy.kube.agent_client import AgentLink

UID = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"
TOKEN = b"correct horse battery staple"
PACKAGE = Path(__file__).parents[3] / "operator"


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


class Pod:
    """What is in one pod."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.volume = folder / "volume"
        self.volume.mkdir()
        self.memory = folder / "memory"
        """The agent's own volume."""
        self.memory.mkdir()
        (folder / "token").write_bytes(TOKEN + b"\n")
        (folder / names.MONITOR_PUBLIC_KEY).write_bytes(PUBLIC_KEY)
        self.port, self.health_port = free_port(), free_port()
        self.agent: subprocess.Popen[bytes] | None = None
        self.environment = {"UNDERSTUDY_HELD_CONTAINERS": "app"}
        self._processes: list[subprocess.Popen[bytes]] = []

    def start_agent(self, *, inside: Sequence[str] = ()) -> subprocess.Popen[bytes]:
        environment = {
            **os.environ,
            "PYTHONPATH": str(PACKAGE),
            "UNDERSTUDY_POD": "pool-abcde",
            "UNDERSTUDY_POD_UID": UID,
            "UNDERSTUDY_DIR": str(self.volume),
            names.MEMORY_VARIABLE: str(self.memory),
            "UNDERSTUDY_TOKEN_FILE": str(self.folder / "token"),
            "UNDERSTUDY_AGENT_PORT": str(self.port),
            "UNDERSTUDY_AGENT_HEALTH_PORT": str(self.health_port),
            **self.environment,
        }
        with (self.folder / "agent.log").open("ab") as log:
            self.agent = subprocess.Popen(
                [*inside, sys.executable, "-m", "understudy.main", "agent"], env=environment, stdout=log, stderr=log
            )
        return self.keep(self.agent)

    def start_container(
        self, command: Sequence[str], args: Sequence[str] = (), *, container: str = "app", inside: Sequence[str] = ()
    ) -> subprocess.Popen[bytes]:
        wrapped = hold_script.held_command(container, command, args, [], directory=str(self.volume))
        with (self.folder / f"{container}.log").open("ab") as log:
            return self.keep(subprocess.Popen([*inside, *wrapped], stdout=log, stderr=log, start_new_session=True))

    def keep(self, process: subprocess.Popen[bytes]) -> subprocess.Popen[bytes]:
        """A process of the pod, which ends with it."""
        self._processes.append(process)
        return process

    def output(self, container: str = "app") -> str:
        return (self.folder / f"{container}.log").read_text()

    def kill(self, process: subprocess.Popen[bytes]) -> None:
        """End a process, of a container all that it has begun too, as with a container's first process."""
        if process.poll() is None and os.getpgid(process.pid) == process.pid:
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()

    def end(self) -> None:
        for process in self._processes:
            self.kill(process)

    def link(self, workload: str = "robot", claim: str = "uid/1", token: bytes = TOKEN, **more) -> AgentLink:
        return AgentLink(
            "127.0.0.1",
            self.port,
            known_to_monitor(token),
            workload,
            claim,
            **{"uid": UID, "pod": "pool-abcde", **more},
        )

    async def page(self, path: str) -> tuple[int, str]:
        """Status and text of a page of the agent's; 0 while it doesn't answer."""

        def get() -> tuple[int, str]:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{self.health_port}{path}", timeout=5) as answer:
                    return answer.status, answer.read().decode()
            except urllib.error.HTTPError as error:
                return error.code, error.read().decode()
            except OSError:
                return 0, ""

        return await asyncio.to_thread(get)


async def eventually(condition, within: float = 30.0):
    """Wait until it holds; what it returned."""
    end = time.monotonic() + within
    while True:
        value = condition()
        if asyncio.iscoroutine(value):
            value = await value
        if value:
            return value
        assert time.monotonic() < end, f"not within {within} s"
        await asyncio.sleep(0.02)


@pytest.fixture
def pod(tmp_path: Path) -> Iterator[Pod]:
    made = Pod(tmp_path)
    yield made
    made.end()
    if (tmp_path / "agent.log").exists():
        print((tmp_path / "agent.log").read_text())


@pytest.fixture
async def links():
    """Closes the links that a test made."""
    made: list[AgentLink] = []
    yield made
    for link in made:
        await link.close()


@pytest.fixture
def ros() -> dict[str, str]:
    """A ROS graph on this machine, of this run alone."""
    return {
        "ROS_DOMAIN_ID": str(10 + os.getpid() % 90),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }


@pytest.fixture
def robot(pod: Pod, ros: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Pod:
    """A pod that isn't held, whose agent is in that graph, as the test's own nodes are."""
    for name, value in ros.items():
        monkeypatch.setenv(name, value)
    pod.environment = {"UNDERSTUDY_HELD_CONTAINERS": "", "UNDERSTUDY_WORKLOAD": "robot"}
    pod.start_agent()
    return pod


@pytest.fixture
def localizer() -> Iterator[Callable[..., None]]:
    """Starts the node that takes /initialpose, in the environment of that moment."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> None:
        command = [sys.executable, str(Path(__file__).parent / "nodes.py"), "localize", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("up")

    yield start
    for process in started:
        process.kill()
        process.wait()
