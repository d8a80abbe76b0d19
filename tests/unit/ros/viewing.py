"""What reads what the monitor tells, one process each: ``python viewing.py ROLE ...``. Says ``ready`` and runs until killed.

diagnoses              each status on /diagnostics, as JSON
draw TOPIC             each snapshot that comes, rebuilt and drawn by py_trees, as JSON
open NAMESPACE PERIOD  the same of a stream of its own, whose topic is printed first; reads lines: a number is another period,
                       "close" closes it, and the answer is printed
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tests.unit.trees.tools import Row, drawn, rebuilt

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def say(what: object) -> None:
    print(json.dumps(what), flush=True)


def diagnoses() -> None:
    from diagnostic_msgs.msg import DiagnosticArray

    rclpy.init()
    node = Node("reader")

    def record(array: DiagnosticArray) -> None:
        for status in array.status:
            say(
                {
                    "at": array.header.stamp.sec + array.header.stamp.nanosec / 1e9,
                    "level": status.level[0],
                    "name": status.name,
                    "message": status.message,
                    "hardware": status.hardware_id,
                    "values": {value.key: value.value for value in status.values},
                }
            )

    node.create_subscription(DiagnosticArray, "/diagnostics", record, 10)
    print("ready", flush=True)
    rclpy.spin(node)


def snapshot(message: Any) -> None:
    rows = [
        Row(
            bytes(b.own_id.uuid),
            bytes(b.parent_id.uuid),
            tuple(bytes(child.uuid) for child in b.child_ids),
            b.type,
            b.status,
            b.name,
            b.message,
        )
        for b in message.behaviours
    ]
    say(
        {
            "changed": message.changed,
            "count": message.statistics.count,
            "interval": message.statistics.tick_interval,
            "stamp": message.statistics.stamp.sec,
            "classes": [b.class_name for b in message.behaviours],
            "levels": sorted({b.blackbox_level for b in message.behaviours}),
            "drawn": drawn(rebuilt(rows)),
        }
    )


def draw(topic: str) -> None:
    from py_trees_ros_interfaces.msg import BehaviourTree

    rclpy.init()
    node = Node("watcher")
    node.create_subscription(BehaviourTree, topic, snapshot, LATCHED)
    print("ready", flush=True)
    rclpy.spin(node)


def own_stream(namespace: str, period: str) -> None:
    from py_trees_ros_interfaces.msg import BehaviourTree
    from py_trees_ros_interfaces.srv import CloseSnapshotStream, OpenSnapshotStream, ReconfigureSnapshotStream

    rclpy.init()
    node = Node("viewer")
    services: dict[str, Any] = {
        "open": OpenSnapshotStream,
        "close": CloseSnapshotStream,
        "reconfigure": ReconfigureSnapshotStream,
    }
    clients = {
        name: node.create_client(type_, f"{namespace}/snapshot_streams/{name}") for name, type_ in services.items()
    }
    print("ready", flush=True)
    assert all(client.wait_for_service(20) for client in clients.values())

    def asked(name: str, done: Callable[[Any], None], **fields: Any) -> None:
        period = fields.pop("period", None)
        request = services[name].Request(**fields)
        if period is not None:
            request.parameters.snapshot_period = float(period)
        clients[name].call_async(request).add_done_callback(lambda future: done(future.result()))

    topic = ""

    def opened(response: Any) -> None:
        nonlocal topic
        topic = response.topic_name
        say(topic)
        node.create_subscription(BehaviourTree, topic, snapshot, LATCHED)

    def read() -> None:
        for line in sys.stdin:
            if line.strip() == "close":
                asked("close", lambda response: say({"closed": response.result}), topic_name=topic)
            else:
                asked("reconfigure", lambda response: say({"set": response.result}), topic_name=topic, period=line)

    asked("open", opened, period=period)
    threading.Thread(target=read, daemon=True).start()
    rclpy.spin(node)


if __name__ == "__main__":
    {"diagnoses": diagnoses, "draw": draw, "open": own_stream}[sys.argv[1]](*sys.argv[2:])
