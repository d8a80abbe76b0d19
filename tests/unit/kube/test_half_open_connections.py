"""A connection to the API server whose other side vanishes without a reset, as that of a node without power."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import sys
import time

import pytest

from tests.support.network_namespaces import network

SERVER = """
import socket, time
listening = socket.create_server(("10.0.0.1", 8080))
connection, _ = listening.accept()
connection.recv(65536)
connection.sendall(b"HTTP/1.1 200 OK\\r\\nTransfer-Encoding: chunked\\r\\n\\r\\n")
time.sleep(300)
"""

WATCH = """
import asyncio, ssl
from understudy.kube.client import FAILURES, PODS, Access, Client

async def main():
    async with Client(Access("http://10.0.0.1:8080", ssl.create_default_context())) as client:
        events = client.watch(PODS, "fleet", version="1")
        print("watching", flush=True)
        try:
            async for event in events:
                print(event, flush=True)
        except FAILURES as error:
            print("ended", flush=True)

asyncio.run(main())
"""


def line(process: subprocess.Popen[str], within: float) -> str:
    """Return the next line that a process prints; empty if it prints none in time."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], within)
    return process.stdout.readline().strip() if ready else ""


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("ip"), reason="network namespaces need root and iproute2")
def test_a_watch_over_a_dead_connection_ends_within_fifteen_seconds() -> None:
    with network() as net:
        serving, watching = net.host("10.0.0.1"), net.host("10.0.0.2")
        server = subprocess.Popen([*serving, sys.executable, "-c", SERVER])
        time.sleep(0.5)
        client = subprocess.Popen([*watching, sys.executable, "-c", WATCH], stdout=subprocess.PIPE, text=True)
        try:
            assert line(client, 30) == "watching"
            time.sleep(1)
            net.cut_off("10.0.0.1")
            cut_at = time.monotonic()
            assert line(client, 20) == "ended"
            assert time.monotonic() - cut_at < 15 + 1
        finally:
            for process in (server, client):
                process.kill()
                process.wait()
