"""The program that ``understudy doctor`` runs in its pods: it sends datagrams, reports which arrived, and lists the
nodes of a ROS graph.

The pod's Python gets this file as text, because its image may have another version than the command.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from typing import Any

from understudy.kube.gates.probes import ProbeReceiver, ProbeSender

INTERVAL = 0.002
"""Seconds between two datagrams at first; the accuracy of the measured times."""

CHECK_PERIOD = 0.1
"""Seconds between two reads of a graph."""


class Inside:
    """The requests that the program answers."""

    def __init__(self) -> None:
        self._senders: dict[str, ProbeSender] = {}
        self._receivers: dict[int, ProbeReceiver] = {}
        self._robot: dict[str, str] = {}

    async def clock(self) -> float:
        """Return the time of this node, in Unix seconds."""
        return time.time()

    async def listen(self, port: int, host: str) -> None:
        """Record what arrives at a port from now on."""
        self._receivers[port] = ProbeReceiver()
        await self._receivers[port].listen(port=port, host=host)

    async def send(self, uid: str, host: str, port: int, seconds: float) -> None:
        """Send for some seconds. A UID that was used before sends from the same port again."""
        sender = self._senders.setdefault(uid, ProbeSender(uid))
        sender.aim(host, port)
        sender.burst(INTERVAL, seconds)

    async def heard(self, uid: str, port: int, since: float) -> dict[str, Any]:
        """Return what arrived from a UID since a time of this clock: how many datagrams, and when the first and the
        last."""
        receiver = self._receivers[port]
        return {
            "count": receiver.count_since(uid, since),
            "first": receiver.first_since(uid, since),
            "last": receiver.last(uid),
            "now": time.time(),
        }

    async def graph(self, environment: dict[str, str], seconds: float) -> list[str]:
        """Return the nodes of a ROS graph, as soon as there are others than this program's, or after the given
        seconds."""
        from understudy.ros.runtime.graph_node import Graph

        for variable in self._robot.keys() - environment.keys():
            os.environ.pop(variable, None)
        os.environ.update(environment)
        self._robot = environment
        graph = Graph("understudy_doctor", domain_id=int(environment.get("ROS_DOMAIN_ID", "0")))
        try:
            end = time.monotonic() + seconds
            while True:
                found = {f"{space.rstrip('/')}/{name}" for name, space in graph.node.get_node_names_and_namespaces()}
                others = sorted(found - {"/understudy_doctor"})
                if others or time.monotonic() > end:
                    return others
                await asyncio.sleep(CHECK_PERIOD)
        finally:
            graph.close()


async def answer(inside: Inside, line: str) -> dict[str, Any]:
    """Answer one line: the name of a request and its arguments."""
    try:
        what, arguments = json.loads(line)
        return {"answer": await getattr(inside, what)(**arguments)}
    except Exception as error:  # whatever the error is, the caller must know it
        return {"error": f"{type(error).__name__}: {error}"}


async def run() -> None:
    """Answer until the input ends."""
    inside = Inside()
    while line := await asyncio.to_thread(sys.stdin.readline):
        print(json.dumps(await answer(inside, line)), flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["graph"]:
        # The import starts this process again with its libraries. Input that was already read would be lost then.
        import rclpy  # noqa: F401
    asyncio.run(run())
    os._exit(0)  # a thread may still be sending
