"""What ``understudy doctor`` runs in its pods: sends datagrams, tells which came, and looks who is in a ROS graph.

A pod's Python is given this file as a text, since its image may be of another version than the one that asks.
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
"""Seconds between two datagrams at first; how exact moments are."""

LOOK = 0.1
"""Seconds between two looks into a graph."""


class Inside:
    """What can be asked for."""

    def __init__(self) -> None:
        self._senders: dict[str, ProbeSender] = {}
        self._receivers: dict[int, ProbeReceiver] = {}
        self._robot: dict[str, str] = {}

    async def clock(self) -> float:
        """The time of this node, in unix seconds."""
        return time.time()

    async def listen(self, port: int, host: str) -> None:
        """Note what comes to a port from now on."""
        self._receivers[port] = ProbeReceiver()
        await self._receivers[port].listen(port=port, host=host)

    async def send(self, uid: str, host: str, port: int, seconds: float) -> None:
        """Send for so long, from the same port again where this UID has been sent from before."""
        sender = self._senders.setdefault(uid, ProbeSender(uid))
        sender.aim(host, port)
        sender.burst(INTERVAL, seconds)

    async def heard(self, uid: str, port: int, since: float) -> dict[str, Any]:
        """What came from a UID since a moment of this clock: how much, and when first and last."""
        receiver = self._receivers[port]
        return {
            "count": receiver.count_since(uid, since),
            "first": receiver.first_since(uid, since),
            "last": receiver.last(uid),
            "now": time.time(),
        }

    async def graph(self, environment: dict[str, str], seconds: float) -> list[str]:
        """The nodes of a ROS graph, as soon as there are others than this one's; at the latest after so long."""
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
                await asyncio.sleep(LOOK)
        finally:
            graph.close()


async def answer(inside: Inside, line: str) -> dict[str, Any]:
    """The answer to a line: what is asked for, and what is given to it."""
    try:
        what, given = json.loads(line)
        return {"answer": await getattr(inside, what)(**given)}
    except Exception as error:  # whatever it was, whoever asks has to know
        return {"error": f"{type(error).__name__}: {error}"}


async def run() -> None:
    """Answer until nobody asks any more."""
    inside = Inside()
    while line := await asyncio.to_thread(sys.stdin.readline):
        print(json.dumps(await answer(inside, line)), flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["graph"]:
        # It begins this process anew with its libraries, and what has been read of the input by then would be lost.
        import rclpy  # noqa: F401
    asyncio.run(run())
    os._exit(0)  # a thread may still be sending
