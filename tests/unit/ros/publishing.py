"""Publishes on /initialpose from this host, each time that a line comes, and says how that went: ``publishing.py SUBSCRIBERS KNOWN``.

It starts when it has discovered that many subscribers, and, with KNOWN ``named``, the names of their nodes too.
"""

import asyncio
import sys

from understudy.ros.actions.calling_node import GraphLocation
from understudy.ros.actions.instance_calls import CallFailed, InstanceCaller
from understudy.ros.dds.host_ids import HOST
from understudy.ros.runtime.graph_node import Graph


async def main(subscribers: int, known: str) -> None:
    graph = Graph("own")
    while not (own := [e.gid[HOST] for e in graph.publishers("/parameter_events") if e.node == "/own"]):
        await asyncio.sleep(0.05)
    while sum(bool(known != "named" or e.node) for e in graph.subscribers("/initialpose")) < subscribers:
        await asyncio.sleep(0.001)
    print("all", flush=True)
    caller = InstanceCaller("caller", place=lambda: GraphLocation(graph.node.context, own[0]))
    while words := (await asyncio.to_thread(sys.stdin.readline)).split():
        try:
            await caller.publish(
                "/initialpose", "std_msgs/msg/String", {"data": words[0]}, float(words[1]), answered=True
            )
            print("published", words[0], flush=True)
        except CallFailed as error:
            print("failed", error, flush=True)


asyncio.run(main(int(sys.argv[1]), sys.argv[2]))
