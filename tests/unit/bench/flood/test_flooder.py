"""The program of the stranger's pod, against sockets of the loopback."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict

import pytest

from bench.flood import flooder
from bench.flood.flooder import Plan
from understudy.kube.gates import probes

SECONDS = 1.5

Sink = tuple[socket.socket, list[bytes]]


@pytest.fixture
def datagrams() -> Iterator[Sink]:
    """A socket, and what arrived at it."""
    found: list[bytes] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        reading = threading.Thread(target=_read, args=(sock, found))
        sock.settimeout(0.1)
        reading.start()
        yield sock, found
    reading.join()


def _read(sock: socket.socket, found: list[bytes]) -> None:
    while sock.fileno() >= 0:
        with contextlib.suppress(OSError):
            found.append(sock.recv(2000))


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """Somebody who never accepts a connection: the kernel does."""
    with socket.create_server(("127.0.0.1", 0)) as sock:
        yield sock


def _port(sock: socket.socket) -> int:
    port: int = sock.getsockname()[1]
    return port


def flooded(*plans: Plan, seconds: float = SECONDS) -> dict[str, float]:
    """Run the program with plans, half a second apart. Returns what it has sent."""
    command = [sys.executable, flooder.__file__, f"{seconds}"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        for plan in plans:
            process.stdin.write(json.dumps(asdict(plan)) + "\n")
            process.stdin.flush()
            time.sleep(0.5)
        assert process.stdout is not None
        found: dict[str, float] = json.loads(process.stdout.read())
        return found


def test_datagrams_imitate_what_they_should(datagrams: Sink) -> None:
    sock, found = datagrams
    uid = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"
    kinds = ("random", "rtps", "probe", f"unsigned:{uid}")
    sent = flooded(Plan(udp=[("127.0.0.1", _port(sock), kind) for kind in kinds], processes=1))
    seen = set(found)
    assert sent["datagrams"] >= len(found) > 0
    assert sent["bytes"] > 100 * sent["datagrams"]
    assert {probe.uid for one in seen if (probe := probes.decode(one)) is not None} == {uid}
    authentic = probes.sign(b"key", 1)
    assert any(len(one) == len(authentic) and one[:4] == authentic[:4] for one in seen)
    assert any(one.startswith(b"RTPS") for one in seen)
    assert {flooder.SMALL, flooder.LARGE} <= {len(one) for one in seen}


def test_connections_are_begun_again_and_again(listener: socket.socket) -> None:
    address = "127.0.0.1", _port(listener)
    sent = flooded(
        Plan(tcp=[(*address, manner) for manner in ("syn", "silent", "garbage", "slow", "pages")], processes=1)
    )
    assert sent["connections begun"] > sent["connections established"] > 0


def test_another_plan_replaces_the_one_before(datagrams: Sink) -> None:
    sock, found = datagrams
    sent = flooded(Plan(udp=[("127.0.0.1", _port(sock), "probe")], processes=1), Plan(), seconds=2.0)
    assert sent["seconds"] == pytest.approx(2.0, abs=0.5)
    time.sleep(0.2)
    arrived = len(found)
    time.sleep(0.2)
    assert sent["datagrams"] > 0
    assert arrived == len(found)


def test_it_ends_with_its_standard_input() -> None:
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, flooder.__file__, "60"],
        input=json.dumps(asdict(Plan())) + "\n",
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0
    assert time.monotonic() - begun < 10
