"""What cuts a pod off from the network, in network namespaces of its own: a pod, and two that it talks to."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.support.network_namespaces import Network, network
from understudy.cli.inject import network_cut

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="takes root, for network namespaces")

POD, ROBOT, MONITOR = "10.91.0.1", "10.91.0.2", "10.91.0.3"
PORT = 7950
INTERVAL = 0.02
LATER = 4e9

TALK = f"""
import json, socket, sys, time
to = [(host, {PORT}) for host in sys.argv[1:]]
here = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
here.bind(("0.0.0.0", {PORT}))
here.setblocking(False)
while True:
    try:
        while True:
            text, (host, _) = here.recvfrom(2048)
            print(json.dumps([host, float(text)]), flush=True)
    except BlockingIOError:
        time.sleep({INTERVAL})
    for one in to:
        here.sendto(b"%f" % time.time(), one)
"""
"""Sends to each of these all the time, from one port to the same, and says what comes and when it was sent. It ends where it can't send."""

BOTH_WAYS = [(POD, ROBOT), (ROBOT, POD), (POD, MONITOR), (MONITOR, POD)]

MARGIN = 0.3
"""Seconds that may pass between a sender's look at the clock and its sending."""


class Talk:
    """A pod that talks with two others all the time, and they with it."""

    def __init__(self, lan: Network, folder: Path) -> None:
        self.pod = lan.host(POD)
        self._folder, self._running = folder, dict[str, subprocess.Popen[bytes]]()
        for host, command in {POD: self.pod, ROBOT: lan.host(ROBOT), MONITOR: lan.host(MONITOR)}.items():
            to = [ROBOT, MONITOR] if host == POD else [POD]
            with (folder / host).open("w") as file:
                self._running[host] = subprocess.Popen([*command, sys.executable, "-c", TALK, *to], stdout=file)

    def received(self, sender: str, receiver: str, since: float, until: float = LATER) -> int:
        """How much of what was sent between two moments was heard so far."""
        assert self._running[sender].poll() is None, f"{sender} couldn't send"
        lines = (self._folder / receiver).read_text().split("\n")[:-1]
        return sum(host == sender and since < sent < until for host, sent in map(json.loads, lines))

    def wait_received(self, since: float, ways: Sequence[tuple[str, str]] = BOTH_WAYS) -> None:
        """Wait until something that was sent after a moment is heard each way."""
        end = time.monotonic() + 60
        while missing := [way for way in ways if not self.received(*way, since)]:
            assert time.monotonic() < end, f"nothing is heard: {missing}"
            time.sleep(0.05)

    def close(self) -> None:
        for running in self._running.values():
            running.kill()
            running.wait()


@pytest.fixture
def talk(tmp_path: Path) -> Iterator[Talk]:
    with network() as lan, contextlib.closing(Talk(lan, tmp_path)) as made:
        made.wait_received(0)
        yield made


def program(pod: list[str], length: float, *networks: str, latest: float = LATER) -> subprocess.Popen[str]:
    """It, in the pod's network, as a container is given it."""
    command = [*pod, sys.executable, "-IS", "-c", Path(network_cut.__file__).read_text(), str(length), *networks]
    environment = {**os.environ, network_cut.LATEST: str(latest)}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def reported_time(running: subprocess.Popen[str], what: str) -> float:
    """When it did what it says next."""
    assert running.stdout is not None, "it is a pipe"
    assert running.stderr is not None, "it is a pipe"
    line = running.stdout.readline()
    assert line, running.stderr.read()
    moment: float = json.loads(line)[what]
    return moment


def test_existing_flows_are_cut_in_both_directions_and_restored_after_the_time(talk: Talk) -> None:
    with program(talk.pod, 1.5) as running:
        cut, back = reported_time(running, "cut"), reported_time(running, "back")
    assert running.returncode == 0
    assert back - cut >= 1.5
    talk.wait_received(back)
    assert not any(talk.received(*way, cut, back - MARGIN) for way in BOTH_WAYS)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_network_is_restored_however_the_cut_ends(talk: Talk, number: signal.Signals) -> None:
    with program(talk.pod, 60) as running:
        cut = reported_time(running, "cut")
        time.sleep(1)
        before = time.time()
        running.send_signal(number)
        running.wait(timeout=60)
        ended = time.time()
    talk.wait_received(ended)
    assert not any(talk.received(*way, cut, before - MARGIN) for way in BOTH_WAYS)


def test_only_the_given_peers_are_unreachable(talk: Talk) -> None:
    with program(talk.pod, 60, f"{MONITOR}/32", "fd00::/8") as running:
        cut = reported_time(running, "cut")
        time.sleep(1)
        talk.wait_received(cut, [(POD, ROBOT), (ROBOT, POD)])
        before = time.time()
        running.terminate()
    talk.wait_received(time.time())
    assert not any(talk.received(*way, cut, before - MARGIN) for way in BOTH_WAYS if MONITOR in way)


RECEIVE = """
import socket, sys
here = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
here.settimeout(1)
here.bind(("::", 7950))
print("listening", flush=True)
here.recv(2048)
"""
SEND = """
import socket, sys
socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).sendto(b"here", (sys.argv[1], 7950))
"""


def arrives(sender: list[str], receiver: list[str], address: str) -> bool:
    """Whether a datagram gets from one to the other, at its address."""
    command = [*receiver, sys.executable, "-c", RECEIVE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as running:
        assert running.stdout is not None, "it is a pipe"
        assert running.stdout.readline(), "it listens"
        subprocess.run([*sender, sys.executable, "-c", SEND, address], check=True)
    return running.returncode == 0


def test_ipv6_addresses_are_cut_off_too() -> None:
    with network() as lan:
        pod, robot, monitor = (lan.host(host) for host in (POD, ROBOT, MONITOR))
        for host, address in ((pod, "fd91::1"), (robot, "fd91::2"), (monitor, "fd91::3")):
            subprocess.run([*host, *f"ip address add {address}/64 dev eth0 nodad".split()], check=True)
        with program(pod, 60, "fd91::3") as running:
            reported_time(running, "cut")
            assert arrives(pod, robot, "fd91::2")
            assert arrives(robot, pod, "fd91::1")
            assert not arrives(pod, monitor, "fd91::3")
            assert not arrives(monitor, pod, "fd91::1")
            running.terminate()
        assert arrives(monitor, pod, "fd91::1")


def test_two_simultaneous_cuts_end_independently(talk: Talk) -> None:
    with program(talk.pod, 60) as first, program(talk.pod, 60) as second:
        reported_time(first, "cut")
        cut = reported_time(second, "cut")
        first.terminate()
        first.wait(timeout=60)
        time.sleep(1)
        before = time.time()
        second.terminate()
    talk.wait_received(time.time())
    assert not any(talk.received(*way, cut, before - MARGIN) for way in BOTH_WAYS)


LOOP = """
import socket, sys
here = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
here.settimeout(10)
here.bind((sys.argv[1], 0))
here.sendto(b"here", here.getsockname())
here.recv(2048)
"""


@pytest.mark.parametrize("address", ["127.0.0.1", POD])
def test_traffic_within_the_pod_is_not_cut(address: str) -> None:
    with network() as lan:
        pod = lan.host(POD)
        with program(pod, 60) as running:
            reported_time(running, "cut")
            done = subprocess.run([*pod, sys.executable, "-c", LOOP, address], timeout=60, check=False)
            running.terminate()
    assert done.returncode == 0


def test_a_late_start_cuts_nothing() -> None:
    running = program([], 60, latest=time.time() - 1)
    out, error = running.communicate(timeout=60)
    assert (running.returncode, out) == (1, "")
    assert_golden("inject", error, "too late")


def test_a_missing_capability_is_reported() -> None:
    running = program(["setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin"], 60)
    _, error = running.communicate(timeout=60)
    assert running.returncode == 1
    assert_golden("inject", error, "permission denied", "NET_ADMIN")
