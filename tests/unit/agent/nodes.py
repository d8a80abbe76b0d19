"""Real ROS 2 nodes for the tests: ``python nodes.py talk TOPIC RATE`` or ``python nodes.py serve SERVICE``."""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


def talk(topic: str, rate: str) -> None:
    from std_msgs.msg import String

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    publisher = Node("talker").create_publisher(String, topic, 10)
    print(f"up {time.time()}", flush=True)
    while True:
        publisher.publish(String(data="x"))
        time.sleep(1 / float(rate))


def serve(service: str) -> None:
    from std_srvs.srv import Trigger

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("server")
    node.create_service(Trigger, service, lambda request, response: response)
    print(f"up {time.time()}", flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    {"talk": talk, "serve": serve}[sys.argv[1]](*sys.argv[2:])
