"""Publishes on /initialpose from this host, and says how that went; a subscriber of its own says what it got."""

import asyncio
import sys
import threading
import time

import rclpy
from std_msgs.msg import String

from understudy.ros.actions.calling_node import GraphLocation
from understudy.ros.actions.instance_calls import CallFailed, InstanceCaller
from understudy.ros.dds.host_ids import HOST
from understudy.ros.runtime.graph_node import Graph


async def main() -> None:
    graph = Graph("own")
    while not (own := [e.gid[HOST] for e in graph.publishers("/parameter_events") if e.node == "/own"]):
        await asyncio.sleep(0.05)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("listener", context=context)
    got = threading.Event()
    node.create_subscription(String, "/initialpose", lambda _: got.set(), 10)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    end = time.monotonic() + 20
    while len(graph.node.get_subscriptions_info_by_topic("/initialpose")) < 2 and time.monotonic() < end:
        await asyncio.sleep(0.05)
    print("both", len(graph.node.get_subscriptions_info_by_topic("/initialpose")), flush=True)
    sys.stdin.readline()
    caller = InstanceCaller("caller", place=lambda: GraphLocation(graph.node.context, own[0]))
    try:
        await caller.publish("/initialpose", "std_msgs/msg/String", {"data": "here"}, 20.0)
        print("published", await asyncio.to_thread(got.wait, 10), flush=True)
    except CallFailed as error:
        print("failed", error, flush=True)


asyncio.run(main())
