"""What the example's processes meet in tests: somebody who steers, and a navigator that only answers."""

from __future__ import annotations

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Odometry
from rclpy.action import ActionServer, GoalResponse
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage


def say(**values: object) -> None:
    print(json.dumps(values), flush=True)


def steer(linear: float, angular: float) -> None:
    """Sends one command twenty times a second."""
    node = Node("steer")
    publisher = node.create_publisher(Twist, "/cmd_vel", 1)
    twist = Twist()
    twist.linear.x, twist.angular.z = linear, angular
    while rclpy.ok():
        publisher.publish(twist)
        time.sleep(0.05)


def listen() -> None:
    """Says the latest of everything that the robot tells."""
    node = Node("listen")
    received: dict[str, object] = {}

    def odometry(message: Odometry) -> None:
        received["odom"] = [
            message.header.frame_id,
            message.child_frame_id,
            message.pose.pose.position.x,
            message.twist.twist.linear.x,
        ]

    def scan(message: LaserScan) -> None:
        received["scan"] = [
            message.header.frame_id,
            len(message.ranges),
            message.angle_min + message.angle_increment * len(message.ranges),
            message.range_max,
            min(message.ranges),
        ]

    def transforms(key: str, message: TFMessage) -> None:
        one = message.transforms[0]
        received[key] = [
            one.header.frame_id,
            one.child_frame_id,
            one.transform.translation.x,
            one.transform.translation.z,
        ]

    def truth(message: PoseStamped) -> None:
        received["truth"] = [message.header.frame_id, message.pose.position.x, message.pose.position.y]

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Odometry, "/odom", odometry, 10)
    node.create_subscription(LaserScan, "/scan", scan, qos_profile_sensor_data)
    node.create_subscription(TFMessage, "/tf", lambda m: transforms("tf", m), 100)
    node.create_subscription(TFMessage, "/tf_static", lambda m: transforms("tf_static", m), latched)
    node.create_subscription(PoseStamped, "/ground_truth/pose", truth, 10)
    node.create_timer(0.2, lambda: say(**received))
    rclpy.spin(node)


def navigate(*outcomes: str) -> None:
    """Answers goals one by one: succeed, abort, or no, for a goal that is rejected."""
    node = Node("navigate")
    left = list(outcomes)

    def accepted(goal: NavigateToPose.Goal) -> GoalResponse:
        say(asked=goal.pose.pose.position.x, frame=goal.pose.header.frame_id)
        if left and left[0] == "no":
            left.pop(0)
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def execute(handle) -> NavigateToPose.Result:  # type: ignore[no-untyped-def]
        outcome = left.pop(0)
        feedback = NavigateToPose.Feedback()
        for _ in range(5):
            feedback.distance_remaining -= 0.1
            handle.publish_feedback(feedback)
            time.sleep(0.05)
        if outcome == "succeed":
            handle.succeed()
            return NavigateToPose.Result()
        handle.abort()
        return NavigateToPose.Result(error_code=9001, error_msg="no way")

    server = ActionServer(node, NavigateToPose, "/navigate_to_pose", execute, goal_callback=accepted)
    say(ready=True)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()
    server.destroy()


if __name__ == "__main__":
    rclpy.init()
    try:
        match sys.argv[1:]:
            case ["steer", linear, angular]:
                steer(float(linear), float(angular))
            case ["listen"]:
                listen()
            case ["navigate", *outcomes]:
                navigate(*outcomes)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
