"""A real agent process, a real application behind the real script, and real sockets that answer or don't."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.agents import known_to_agent, known_to_monitor
from tests.unit.agent.conftest import PACKAGE, Pod, eventually
from understudy.agent import isolation
from understudy.agent.control_channel import ControlChannel, Operation, Peer, Refused
from understudy.agent.isolation import Address, ConnectionAttempts, Isolation
from understudy.api import names
from understudy.api.protocol import freeze_script as script
from understudy.api.protocol import secure_channel
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.secure_channel import AgentSecret

COUNTING = """
import sys, time
while True:
    with open(sys.argv[1], "a") as file:
        file.write(".")
    time.sleep(0.02)
"""


def dropping() -> socket.socket:
    """A listener whose queue is full: as with a host that is gone, nobody answers who asks it."""
    sock = socket.socket()
    sock.bind(("127.0.0.1", 0))
    sock.listen(0)
    sock.setblocking(False)
    filling = []
    for _ in range(4):
        one = socket.socket()
        one.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            one.connect(sock.getsockname())
        filling.append(one)
    _kept.append(filling)
    return sock


_kept: list[list[socket.socket]] = []


@pytest.fixture
def silent() -> Iterator[socket.socket]:
    sock = dropping()
    yield sock
    sock.close()
    for filling in _kept:
        for one in filling:
            one.close()
    _kept.clear()


async def answers(address: Address, within: float) -> bool:
    questions = ConnectionAttempts()
    started_at = time.monotonic()
    questions.ask(address, started_at)
    while not (found := questions.answers(started_at)):
        if time.monotonic() - started_at > within:
            assert questions.answers(started_at + isolation.ANSWER) == [(address, started_at, False)], "it is given up"
            return False
        await asyncio.sleep(0.01)
    assert found[0][:2] == (address, started_at)
    return found[0][2]


async def test_accepting_and_refusing_hosts_count_as_answers_and_silent_ones_do_not(silent: socket.socket) -> None:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(8)
        host, port = listening.getsockname()
        assert await answers(Address(host, port), 20)
        assert await answers(Address(host, port, accept=True), 20)
    assert await answers(Address(host, port), 20), "nobody listens there now, and its kernel says so"
    assert not await answers(Address(host, port, accept=True), 20)
    assert not await answers(Address(*silent.getsockname()), 0.3)


def test_the_address_of_the_api_server_comes_from_the_environment() -> None:
    environment = {"KUBERNETES_SERVICE_HOST": "10.96.0.1", "KUBERNETES_SERVICE_PORT": "443"}
    assert isolation.apiserver(environment) == Address("10.96.0.1", 443, accept=True)
    assert isolation.apiserver({}) is None
    assert isolation.apiserver({**environment, "KUBERNETES_SERVICE_HOST": "api.example"}) is None


class Application:
    """The application behind the script, its agent's part in this process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.output = folder, folder / "output"
        os.mkfifo(folder / script.fence_name("drive"), 0o666)
        # A process namespace of its own as a container has it.
        self.process = subprocess.Popen(
            [
                *("unshare", "--pid", "--fork", "--mount-proc", "--kill-child"),
                *script.fenced_command(
                    "drive",
                    [sys.executable, "-c", COUNTING, str(self.output)],
                    [],
                    scope="all",
                    directory=str(folder),
                ),
            ]
        )

    def written(self) -> int:
        return self.output.stat().st_size if self.output.exists() else 0

    async def goes_on(self) -> None:
        before = self.written()
        await eventually(lambda: self.written() > before + 2, 25)

    async def is_held(self) -> None:
        async def still() -> bool:
            before = self.written()
            await asyncio.sleep(0.25)
            return self.written() == before

        await eventually(still, 25)


@pytest.fixture
def application(tmp_path: Path) -> Iterator[Application]:
    probe = ["unshare", "--pid", "--fork", "--mount-proc", "true"]
    if not shutil.which("unshare") or subprocess.run(probe, capture_output=True, check=False, timeout=20).returncode:
        pytest.skip("no process namespace can be made here")
    found = Application(tmp_path)
    yield found
    found.process.kill()
    found.process.wait()


class Session:
    """A session as the fence sees it."""

    count = 1

    def __init__(self) -> None:
        self.aborted = 0

    def delivered(self) -> bool:
        return False

    def abort(self) -> None:
        self.aborted += 1


def running(isolation: Isolation) -> asyncio.Task[None]:
    return asyncio.create_task(isolation.run())


async def test_the_application_is_held_while_nobody_answers_and_continues_with_the_monitors_permit(
    application: Application, silent: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes: list[str] = []
    isolation = Isolation(application.folder, ["drive"], on_change=lambda: changes.append(isolation.reason))
    isolation.contacts = session = Session()
    host, port = silent.getsockname()
    monkeypatch.setattr(names, "PROBE_PORT", port)
    peer = Peer("w", "", host)
    await isolation.renew({"witnesses": []}, peer)
    assert "has answered the agent yet" in isolation.unfenced
    task = running(isolation)
    await application.goes_on()
    assert isolation.since is None, "nobody has ever answered: silence says nothing"

    with socket.socket() as closed:  # whose kernel refuses
        closed.bind((host, 0))
        monkeypatch.setattr(names, "PROBE_PORT", closed.getsockname()[1])
        await isolation.renew({"witnesses": ["127.0.0.2"]}, peer)
        await eventually(lambda: not isolation.unfenced, 25)
        await application.goes_on()
        assert isolation.since is None

        monkeypatch.setattr(names, "PROBE_PORT", port)
        await isolation.renew({"witnesses": []}, peer)
        await eventually(lambda: isolation.since is not None, 25)
        await application.is_held()
        assert "frozen since" in isolation.reason
        assert not session.aborted
        again = Isolation(application.folder, ["drive"])
        assert again.since is not None, "an agent that is restarted meanwhile knows"

        monkeypatch.setattr(names, "PROBE_PORT", closed.getsockname()[1])
        await isolation.renew({"witnesses": []}, peer)
        await eventually(lambda: "waits for the monitor's decision" in isolation.reason, 25)
        assert session.aborted == 1, "for a fresh session"
        await application.is_held()
        await isolation.renew({"witnesses": [], "word": "Stay"}, peer)
        assert "another instance has replaced it" in isolation.reason
        await application.is_held()
        await isolation.renew({"witnesses": [], "word": "Go"}, peer)
        assert (isolation.reason, isolation.since) == ("", None)
        await application.goes_on()
    task.cancel()
    assert [bool(reason) for reason in changes] == [False, True, True, True, False]


async def test_one_answering_witness_is_enough(
    application: Application, silent: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation = Isolation(application.folder, ["drive"])
    host, port = silent.getsockname()
    with socket.socket() as closed:
        closed.bind(("127.0.0.2", port))  # the same port at another address, where nobody listens
        monkeypatch.setattr(names, "PROBE_PORT", port)
        await isolation.renew({"witnesses": ["127.0.0.2"]}, Peer("w", "", host))
        task = running(isolation)
        await eventually(lambda: not isolation.unfenced, 25)
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            await application.goes_on()
            assert isolation.since is None
        task.cancel()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"witnesses": "all"}, "list of addresses"),
        ({"witnesses": [5]}, "list of addresses"),
        ({"word": "Run"}, "Go or Stay"),
    ],
)
async def test_invalid_requests_are_refused(tmp_path: Path, body: dict[str, object], words: str) -> None:
    with pytest.raises(Refused, match=words):
        await Isolation(tmp_path, ["drive"]).renew(body, Peer("w", "", "127.0.0.1"))


def test_containers_that_cannot_be_held_are_reported(tmp_path: Path) -> None:
    isolation = Isolation(tmp_path, ["drive"], unfenced=["lamp"])
    assert isolation.unfenced == "container lamp has no command in the template"
    assert Isolation(tmp_path, []).unfenced == "", "and nothing is where nothing has to be"


def test_the_init_container_creates_the_files_that_hold_containers(tmp_path: Path) -> None:
    (tmp_path / "in.xml").write_text("<profiles/>")
    environment = {
        "PYTHONPATH": str(PACKAGE),
        "UNDERSTUDY_PROFILES": str(tmp_path / "in.xml"),
        "UNDERSTUDY_DIR": str(tmp_path),
        names.FENCED_VARIABLE: "drive lamp",
    }
    for _ in range(2):
        command = [sys.executable, "-m", "understudy.main", "prepare"]
        subprocess.run(command, env=environment, check=True, timeout=60)
    for container in ("drive", "lamp"):
        path = tmp_path / script.fence_name(container)
        assert path.is_fifo()
        assert path.stat().st_mode & 0o777 == 0o666


async def test_a_claimed_pod_of_a_robot_with_ownership_strength_can_be_held(pod: Pod, links) -> None:
    pod.start_agent()
    command = [sys.executable, "-c", COUNTING, str(pod.folder / "output")]
    pod.start_container(script.fenced_command("app", command, [], scope="own", directory=str(pod.volume)))
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 25)
    assert not (pod.volume / script.fence_name("app")).exists()
    profiles = f"<ownershipStrength><value>${{{names.STRENGTH_VARIABLE}}}</value></ownershipStrength>"
    await link.start({}, {}, profiles=profiles)
    await eventually(lambda: (pod.folder / "output").exists(), 25)
    assert (pod.volume / script.fence_name("app")).is_fifo()
    status = await link.wait_for(lambda s: s.phase != "Held", 25)
    assert status.unfenced == "neither the monitor nor another pod has answered the agent yet"
    assert isolation.built(pod.volume, ["app", "lamp"]) == ("app",), "and an agent that is restarted knows"


async def test_an_agent_reports_that_its_application_is_held(pod: Pod, links) -> None:
    pod.environment = {"UNDERSTUDY_WORKLOAD": "robot", names.FENCED_VARIABLE: "drive"}
    os.mkfifo(pod.volume / script.fence_name("drive"))
    (pod.volume / script.HELD_NAME).touch()
    pod.start_agent()
    links.append(link := pod.link())
    status = await link.wait_for(lambda s: s.cut_off is not None, 25)
    assert not status.ready
    assert "frozen since" in status.reason
    await link.request("lease", {"witnesses": [], "word": "Go"})
    status = await link.wait_for(lambda s: s.cut_off is None, 25)
    assert not (pod.volume / script.HELD_NAME).exists()
    assert json.dumps(status.to_wire())


class Pretending:
    """What sessions serve, as little of it as there may be."""

    version, uid = 0, "uid"

    def secret(self) -> AgentSecret:
        return known_to_agent(b"token")

    def refuses(self, workload: str, claim: str) -> str | None:
        return None

    def status(self) -> AgentStatus:
        return AgentStatus()

    async def changed(self, version: int) -> None:
        await asyncio.sleep(3600)

    def operations(self) -> dict[str, Operation]:
        return {}


async def test_a_session_shows_whether_sent_data_was_received_and_ends_at_once() -> None:
    sessions = ControlChannel(Pretending())
    server = await sessions.serve(0, host="127.0.0.1")
    reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname(), limit=1024)
    assert not sessions.delivered(), "there is none"
    await secure_channel.connect(reader, writer, uid="uid", secret=known_to_monitor(b"token"), workload="w", claim="")
    await eventually(lambda: sessions.count == 1 and sessions.delivered(), 25)
    # Who doesn't read doesn't take in what doesn't fit into the kernels' buffers.
    for _ in range(64):
        sessions.publish({"filling": "x" * 262144})
    await eventually(lambda: not sessions.delivered(), 25)
    sessions.abort()
    with pytest.raises(ConnectionResetError):
        await asyncio.wait_for(reader.read(-1), 25)
    await eventually(lambda: sessions.count == 0, 25)
    writer.close()
    server.close()


async def test_an_error_of_the_check_keeps_the_hold_and_an_instance_without_witnesses_is_held(
    application: Application, silent: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation = Isolation(application.folder, ["drive"])
    host, _ = silent.getsockname()
    answers, failing = ConnectionAttempts.answers, [0]

    def seldom(questions: ConnectionAttempts, now: float) -> list[tuple[Address, float, bool]]:
        if failing[0]:
            failing[0] -= 1
            raise RuntimeError("out of the blue")
        return answers(questions, now)

    monkeypatch.setattr(ConnectionAttempts, "answers", seldom)
    with socket.socket() as closed:  # whose kernel refuses
        closed.bind((host, 0))
        monkeypatch.setattr(names, "PROBE_PORT", closed.getsockname()[1])
        await isolation.renew({"witnesses": []}, Peer("w", "", host))
        task = running(isolation)
        await eventually(lambda: not isolation.unfenced, 25)
        failing[0] = 1
        await eventually(lambda: not failing[0], 25)
        await asyncio.sleep(0.6)
        assert isolation.since is None, "it goes on and is answered"
        failing[0] = 1_000_000
        await eventually(lambda: isolation.since is not None, 25)
        await application.is_held()
        assert not task.done()
        task.cancel()


async def test_a_witness_without_an_address_counts_as_silent(
    application: Application, silent: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation = Isolation(application.folder, ["drive"])
    host, port = silent.getsockname()
    with socket.socket() as closed:
        closed.bind(("127.0.0.2", port))
        monkeypatch.setattr(names, "PROBE_PORT", port)
        await isolation.renew({"witnesses": ["a\0b", "127.0.0.2"]}, Peer("w", "", host))
        task = running(isolation)
        await eventually(lambda: not isolation.unfenced, 25)
        assert not task.done()
        task.cancel()
