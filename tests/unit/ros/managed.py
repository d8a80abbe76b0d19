"""A real managed node and what else an instance may serve: ``python managed.py [slow|refusing]``. Prints ``ready`` and runs until killed.

/managed       lifecycle node with parameters speed (double), label (string), count (integer)
/switch        std_srvs/SetBool: answers with the value of the request
/never         std_srvs/Trigger that takes a minute
/second        std_srvs/Trigger that leaves the first request unanswered
/initialpose   is subscribed to; what came is published latched on /taken
"""

from __future__ import annotations

import sys
import time


def run(kind: str) -> None:
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy._rclpy_pybind11 import RCLError
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String
    from std_srvs.srv import SetBool, Trigger

    class Managed(LifecycleNode):
        refused = False

        def on_configure(self, state):
            time.sleep(2.0 if kind == "slow" else 0.0)
            return TransitionCallbackReturn.SUCCESS

        def on_activate(self, state):
            if kind == "refusing" and not Managed.refused:
                Managed.refused = True
                return TransitionCallbackReturn.FAILURE
            return super().on_activate(state)

    rclpy.init()
    node = Managed("managed")
    node.declare_parameter("speed", 1.0)
    node.declare_parameter("label", "a")
    node.declare_parameter("count", 1)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    taken = node.create_publisher(String, "/taken", latched)

    def switch(request, response):
        response.success, response.message = request.data, "on" if request.data else "off"
        return response

    def never(request, response):
        time.sleep(60)
        return response

    asked = []

    def second(request, response):
        asked.append(request)
        time.sleep(600 if len(asked) == 1 else 0)
        response.success = True
        return response

    aside = ReentrantCallbackGroup()
    node.create_service(SetBool, "/switch", switch)
    node.create_service(Trigger, "/never", never, callback_group=aside)
    node.create_service(Trigger, "/second", second, callback_group=aside)
    node.create_subscription(
        PoseWithCovarianceStamped,
        "/initialpose",
        lambda m: taken.publish(String(data=f"{m.header.frame_id} {m.pose.pose.position.x} {m.pose.covariance[35]}")),
        10,
    )
    executor = MultiThreadedExecutor(3)
    executor.add_node(node)
    print("ready", flush=True)
    while True:
        try:
            executor.spin()
        except RCLError as refused:  # rclpy does not answer a transition that this state does not have: it raises
            print(refused, file=sys.stderr, flush=True)


if __name__ == "__main__":
    run((sys.argv[1:] or [""])[0])
