"""Connections to the API server that are dead without a reset: the other side has vanished, or a proxy keeps them open."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import select
import shutil
import ssl
import subprocess
import sys
import time
from collections.abc import AsyncIterator

import pytest
from aiohttp import web

from tests.support.http_server import serving
from tests.support.network_namespaces import network
from understudy.kube import client, watched_collection
from understudy.kube.client import PODS, Access, Client, Object
from understudy.kube.watched_collection import Reflector

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
        watch = subprocess.Popen([*watching, sys.executable, "-c", WATCH], stdout=subprocess.PIPE, text=True)
        try:
            assert line(watch, 30) == "watching"
            time.sleep(1)
            net.cut_off("10.0.0.1")
            cut_at = time.monotonic()
            assert line(watch, 20) == "ended"
            assert time.monotonic() - cut_at < 15 + 1
        finally:
            for process in (server, watch):
                process.kill()
                process.wait()


class Proxy:
    """Forwards connections to a port of this machine, as a load balancer does between a monitor and the API server."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._broken: set[asyncio.StreamWriter] = set()
        self._clients: set[asyncio.StreamWriter] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward one connection until one side ends it."""
        from_server, to_server = await asyncio.open_connection("127.0.0.1", self._port)
        self._clients.add(writer)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._forward(reader, to_server))
                group.create_task(self._forward(from_server, writer))
        finally:
            self._clients.discard(writer)
            for each in (writer, to_server):
                each.close()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            if writer not in self._broken:
                writer.write(data)
        writer.close()

    def fall_silent(self) -> None:
        """Deliver nothing more to the present clients. Their connections stay open, so that the kernel's probes are answered."""
        self._broken |= self._clients


class Fleet:
    """The pods of a namespace, over HTTP. A watch reports only deletions, and no bookmarks."""

    def __init__(self) -> None:
        self.version, self.pods = 5, {"a", "b"}
        self.lists = 0
        self.watching = asyncio.Event()
        self._deleted: asyncio.Queue[str] = asyncio.Queue()

    def pod(self, name: str) -> Object:
        """A pod at the present version."""
        return {"metadata": {"name": name, "uid": f"uid-{name}", "resourceVersion": str(self.version)}}

    def delete(self, name: str) -> None:
        """Delete a pod, at the next version."""
        self.version += 1
        self.pods.remove(name)
        self._deleted.put_nowait(name)

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a list or a watch."""
        if "watch" not in request.query:
            self.lists += 1
            items = [self.pod(name) for name in sorted(self.pods)]
            return web.json_response({"metadata": {"resourceVersion": str(self.version)}, "items": items})
        response = web.StreamResponse()
        await response.prepare(request)
        self.watching.set()
        while True:
            name = await self._deleted.get()
            await response.write(json.dumps({"type": "DELETED", "object": self.pod(name)}).encode() + b"\n")


@contextlib.asynccontextmanager
async def watched_through_a_proxy() -> AsyncIterator[tuple[Fleet, Proxy, Reflector]]:
    """A copy of a fleet's pods whose watch goes through a proxy and runs."""
    fleet, application = Fleet(), web.Application()
    application.router.add_get("/api/v1/namespaces/fleet/pods", fleet.answer)
    async with serving(application, shutdown_timeout=0.1) as url:
        proxy = Proxy(int(url.rpartition(":")[2]))
        server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        async with server, Client(Access(f"http://127.0.0.1:{port}", ssl.create_default_context())) as api:
            pods = Reflector(api, PODS, "fleet")
            running = asyncio.create_task(pods.run())
            try:
                await asyncio.wait_for(fleet.watching.wait(), 10)
                fleet.delete("b")
                await known(pods, {"a"})  # the watch works
                assert fleet.lists == 1
                yield fleet, proxy, pods
            finally:
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)


async def known(pods: Reflector, names: set[str]) -> None:
    """Wait until these pods are known and no others. Raises TimeoutError if that takes long."""
    async with asyncio.timeout(10):
        while set(pods.items) != names:
            await asyncio.sleep(0.01)


async def test_a_watch_that_a_proxy_keeps_open_without_data_ends_and_the_objects_are_listed_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The proxy answers the kernel's probes, so that only the missing bookmarks show it."""
    monkeypatch.setattr(client, "SILENCE", 0.5)
    async with watched_through_a_proxy() as (fleet, proxy, pods):
        proxy.fall_silent()
        fleet.delete("a")
        await known(pods, set())
        assert fleet.lists == 2


async def test_a_watch_that_lacks_what_another_answer_has_ends_long_before_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watched_collection, "LATE", 0.5)
    async with watched_through_a_proxy() as (fleet, proxy, pods):
        proxy.fall_silent()
        fleet.pods.add("c")
        fleet.version += 1
        created = fleet.pod("c")
        fleet.delete("a")
        pods.put(created)
        await known(pods, {"c"})
        assert fleet.lists == 2
