"""Real ROS 2 nodes for the tests: ``python nodes.py ROLE ...``.

talk TOPIC RATE     std_msgs/String
serve SERVICE       std_srvs/Trigger
localize [DEAF]     lifecycle node /localizer with parameter speed: once configured, it says each /initialpose that it is
                    given on /amcl_pose, latched, but not the first DEAF of them
"""

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


def localize(deaf: str = "0") -> None:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
    from rclpy.qos import DurabilityPolicy, QoSProfile

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    class Localizer(LifecycleNode):
        poses_received = 0

        def on_configure(self, state):
            self.pose_publisher = rclpy.node.Node.create_publisher(
                self, PoseWithCovarianceStamped, "/amcl_pose", latched
            )
            self.create_subscription(PoseWithCovarianceStamped, "/initialpose", self.take, 1)
            return TransitionCallbackReturn.SUCCESS

        def take(self, message):
            Localizer.poses_received += 1
            if Localizer.poses_received > int(deaf):
                self.pose_publisher.publish(message)

    node = Localizer("localizer")
    node.declare_parameter("speed", 0.25)
    print(f"up {time.time()}", flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    {"localize": localize, "talk": talk, "serve": serve}[sys.argv[1]](*sys.argv[2:])
