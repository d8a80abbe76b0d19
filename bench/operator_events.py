"""Measures what the operator's event source costs: kopf for every kind, or kopf for our own kinds and `runtime.watches`
for the others.

    scripts/bench operator_events [--robots 1000]

A stub API server on loopback serves lists and watches of a fleet's objects, about 9 objects per robot. Each variant
runs in a process of its own that only fills the store. Measured: processor time and seconds until the process has
seen every object, its memory after that, and the delay of a burst of changes from the server's write to the store.
docs/explanation/operator-events.md says what follows from the figures.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import resource as usage
import ssl
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import aiohttp
from aiohttp import web

from bench.results import quantile
from understudy.api import names
from understudy.controller.observed.kube_objects import MANAGED_BY
from understudy.controller.reconcile.object_store import Store
from understudy.controller.runtime import kopf_handlers, resync, watches
from understudy.kube.client import CRDS, NAMESPACES, PAGE, Access, Client, Object, Resource

ALL = (*kopf_handlers.WATCHED, *(resource for resource, _ in watches.WATCHED))
SERVED = (*ALL, CRDS, NAMESPACES)
"""kopf itself reads the last two."""

OF_A_ROBOT = {"robotworkloads": 1, "pods": 3, "replicasets": 2, "deployments": 1, "networkpolicies": 2}
BURST = 300
"""Number of pods that change at once."""


def made(plural: str, robot: int, number: int, version: int) -> Object:
    """Return an object as large as a real one (a pod has about 10 kB)."""
    name = f"robot-{robot:04d}-{number}"
    metadata: Object = {
        "name": name,
        "namespace": f"fleet-{robot // 100}",
        "uid": f"{plural}-{name}",
        "resourceVersion": str(version),
        "creationTimestamp": "2026-01-01T00:00:00Z",
        "labels": {**MANAGED_BY, names.WORKLOAD: f"robot-{robot:04d}"},
        "managedFields": [{"manager": "m", "fieldsV1": {f"f:field-{i}": {"f:name": {}} for i in range(20)}}],
    }
    container = {
        "name": "application",
        "image": "registry.example/navigation:1.0",
        "env": [{"name": f"VARIABLE_{i}", "value": f"{name if i == 0 else i}"} for i in range(20)],
        "volumeMounts": [{"name": f"volume-{i}", "mountPath": f"/var/volume-{i}"} for i in range(4)],
        "resources": {"requests": {"cpu": "1", "memory": "1Gi"}},
    }
    template: Object = {"metadata": {"labels": metadata["labels"]}, "spec": {"containers": [container, container]}}
    if plural == "pods":
        state = {"name": "application", "ready": True, "state": {"running": {"startedAt": "2026-01-01T00:00:00Z"}}}
        conditions = [{"type": t, "status": "True"} for t in ("Ready", "Initialized", "PodScheduled")]
        status = {"phase": "Running", "conditions": conditions, "containerStatuses": [state, state]}
        return {"metadata": metadata, "spec": {**template["spec"], "nodeName": "n"}, "status": status}
    return {"metadata": metadata, "spec": {"template": template}, "status": {"observedGeneration": 1}}


class Server:
    """Serves lists and watches of a fleet's objects."""

    def __init__(self, robots: int) -> None:
        self.version = 1000
        self.items: dict[str, list[Object]] = defaultdict(list)
        for plural, count in OF_A_ROBOT.items():
            self.items[plural] = [made(plural, r, n, self.version) for r in range(robots) for n in range(count)]
        self._watches: dict[str, list[asyncio.Queue[Object]]] = defaultdict(list)

    async def discovery(self, request: web.Request) -> web.Response:
        """Return the resources of the API, which kopf reads at its start."""
        groups = sorted({(r.group, r.version) for r in SERVED if r.group})
        if request.path == "/api":
            return web.json_response({"versions": ["v1"]})
        if request.path == "/apis":
            found = [{"name": g, "versions": [{"version": v}], "preferredVersion": {"version": v}} for g, v in groups]
            return web.json_response({"groups": found})
        known = [
            {
                "name": r.plural,
                "kind": r.plural.title(),
                "singularName": "",
                "namespaced": True,
                "verbs": ["list", "watch"],
            }
            for r in SERVED
            if r.path(None).rpartition("/")[0] == request.path
        ]
        return web.json_response({"resources": known})

    async def collection(self, request: web.Request) -> web.StreamResponse:
        """Return a list in parts, or a watch."""
        plural = request.path.rpartition("/")[2]
        if "watch" not in request.query:
            begin, limit = int(request.query.get("continue") or 0), int(request.query.get("limit") or PAGE)
            found = self.items[plural]
            more = str(begin + limit) if begin + limit < len(found) else ""
            head = {"apiVersion": "v1", "kind": "ObjectList", "items": found[begin : begin + limit]}
            return web.json_response(head | {"metadata": {"resourceVersion": str(self.version), "continue": more}})
        response = web.StreamResponse()
        await response.prepare(request)
        queue: asyncio.Queue[Object] = asyncio.Queue()
        self._watches[plural].append(queue)
        if request.query.get("resourceVersion") == "0":
            for item in self.items[plural]:
                await self._send(response, "ADDED", item)
        await self._send(response, "BOOKMARK", {"metadata": {"resourceVersion": str(self.version)}})
        while True:
            await self._send(response, "MODIFIED", await queue.get())

    async def _send(self, response: web.StreamResponse, kind: str, item: Object) -> None:
        await response.write(json.dumps({"type": kind, "object": item}).encode() + b"\n")

    async def change(self, _: web.Request) -> web.Response:
        """Change many pods at once, each with the time of its change."""
        for item in self.items["pods"][:BURST]:
            self.version += 1
            metadata = {**item["metadata"], "resourceVersion": str(self.version)}
            metadata["annotations"] = {"changed": str(time.monotonic())}
            for queue in self._watches["pods"]:
                queue.put_nowait({**item, "metadata": metadata})
        return web.Response()

    async def run(self, port: Any) -> None:
        """Serve until the process is ended."""
        app = web.Application()
        app.router.add_get("/change", self.change)
        for path in {"/api", "/apis", "/api/v1", *(r.path(None).rpartition("/")[0] for r in SERVED)}:
            app.router.add_get(path, self.discovery)
        app.router.add_get("/{tail:.*}", self.collection)
        runner = web.AppRunner(app, access_log=None, handler_cancellation=True)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        port.send(runner.addresses[0][1])
        await asyncio.Event().wait()


async def measure(way: str, port: int, expected: int) -> dict[str, float]:
    """Return the figures of one way."""
    kopf_handlers.quiet()
    access = Access(f"http://127.0.0.1:{port}", ssl.create_default_context())
    store, delays, seen = Store(), list[float](), set[str]()
    everything, all_changed = asyncio.Event(), asyncio.Event()

    def see(resource: Resource, item: Object, gone: bool) -> None:
        metadata = item["metadata"]
        if resync.kept(resource, item):
            store.put(resource, item)
        if changed := (metadata.get("annotations") or {}).get("changed"):
            delays.append(time.monotonic() - float(changed))
            if len(delays) == BURST:
                all_changed.set()
        seen.add(metadata["uid"])
        if len(seen) >= expected:
            everything.set()

    before, begun = time.process_time(), time.monotonic()
    async with Client(access, connections=0) as client:
        if way == "kopf":
            kopf_handlers.WATCHED = ALL  # type: ignore[assignment]
            tasks = [asyncio.create_task(kopf_handlers.watch(see, access, ()))]
        else:
            tasks = [asyncio.create_task(kopf_handlers.watch(see, access, ()))]
            tasks.append(asyncio.create_task(watches.watch(client, see, ())))
        await everything.wait()
        listing, elapsed = time.process_time() - before, time.monotonic() - begun
        await asyncio.sleep(8)  # wait until kopf's workers have ended
        memory = _memory()
        idle, begun = time.process_time(), time.monotonic()
        await asyncio.sleep(10)
        idle = (time.process_time() - idle) / (time.monotonic() - begun) * 1000
        before = time.process_time()
        async with aiohttp.ClientSession() as session:
            await session.get(f"{access.server}/change")
        await all_changed.wait()
        burst = time.process_time() - before
        for task in tasks:
            task.cancel()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*tasks, return_exceptions=True), 5)
    return {
        "listing CPU (s)": listing,
        "listing (s)": elapsed,
        "memory (MB)": memory,
        "most memory (MB)": usage.getrusage(usage.RUSAGE_SELF).ru_maxrss / 1e3,
        "idle (mCPU)": idle,
        f"CPU of {BURST} changes (ms)": burst * 1000,
        "delay p50 (ms)": quantile(delays, 0.5) * 1000,
        "delay p99 (ms)": quantile(delays, 0.99) * 1000,
    }


def _memory() -> float:
    """Return the resident memory of this process, in MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * usage.getpagesize() / 1e6


def _serve(robots: int, port: Any) -> None:
    asyncio.run(Server(robots).run(port))


def _measure(way: str, port: int, expected: int, answer: Any) -> None:
    answer.send(asyncio.run(measure(way, port, expected)))


def main(argv: Sequence[str] | None = None) -> int:
    """Measure both ways, print their figures side by side, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=1000)
    options = parser.parse_args(argv)
    processes = multiprocessing.get_context("spawn")
    ours, theirs = processes.Pipe()
    server = processes.Process(target=_serve, args=(options.robots, theirs))
    server.start()
    port, expected = ours.recv(), options.robots * sum(OF_A_ROBOT.values())
    found: dict[str, dict[str, float]] = {}
    try:
        for way in ("kopf", "both"):
            process = processes.Process(target=_measure, args=(way, port, expected, theirs))
            process.start()
            found[way] = ours.recv()
            process.terminate()
            process.join()
    finally:
        server.terminate()
    print(f"{options.robots} robots, {expected} objects")
    for name in found["kopf"]:
        print(f"{name:28} kopf alone {found['kopf'][name]:8.1f}   kopf and watches {found['both'][name]:8.1f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
