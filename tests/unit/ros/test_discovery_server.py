"""A discovery server that takes the place of another, as the image starts it, with real participants."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from tests.unit.ros.processes import PACKAGE

pytestmark = pytest.mark.ros

SCRIPT = PACKAGE.parent / "docker" / "understudy-discovery-server"


@pytest.fixture
def start(
    dds: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Starts a server, at the same address as any before, that participants made from then on know."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    started: list[subprocess.Popen[bytes]] = []
    environment = {**os.environ, "UNDERSTUDY_ENVIRONMENT": sys.prefix, "HOME": str(tmp_path)}

    def server() -> subprocess.Popen[bytes]:
        process = subprocess.Popen([SCRIPT, "127.0.0.1", str(port)], env=environment, stdout=subprocess.DEVNULL)
        started.append(process)
        return process

    monkeypatch.setenv("ROS_DISCOVERY_SERVER", f"127.0.0.1:{port}")
    yield server
    for process in started:
        process.kill()
        process.wait()


def test_whoever_comes_after_another_server_finds_who_was_there_before(start, processes) -> None:
    def hear() -> None:
        reader = processes.node("obey", "/chat", json.dumps({"publisher": "127.0.0.1"}))
        assert processes.line(reader, 60), "a sample's sender"

    server = start()
    processes.node("publish", "/chat", "10")
    hear()
    time.sleep(4.0)  # until all that they have to tell the server has been taken by it
    server.kill()
    server.wait()
    start()
    hear()
