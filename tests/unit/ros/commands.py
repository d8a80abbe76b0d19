"""Both sides of a robot's interfaces, one process each, for tests of how old a command is when it arrives.

``python commands.py send``: the time, ten times a second on topics and twice a second as a request of a service and as
the goal of an action. ``python commands.py once``: the last two each time that a line is read, ready when the robot
has answered both.
``python commands.py receive``: the robot. Prints which output brought a command, and how old it is in seconds.

All of them are reliable with a depth of 10, which is the default, but for two topics.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

TOPIC, SERVICE, ACTION = "/stamp", "/ask", "/go"
UNLIMITED, LATCHED = "/stamp_all", "/stamp_latched"

_DAY = 86_400_000
"""Goals say the time of the day, in milliseconds: they have 32 bits for it."""


def qualities() -> dict[str, Any]:
    """The QoS of each topic."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliable = ReliabilityPolicy.RELIABLE
    return {
        TOPIC: 10,
        UNLIMITED: QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliable),
        LATCHED: QoSProfile(depth=10, reliability=reliable, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    }


class Sender:
    """The instance's side."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.action import ActionClient
        from rclpy.node import Node
        from std_msgs.msg import String
        from test_msgs.action import Fibonacci
        from test_msgs.srv import BasicTypes

        rclpy.init()
        self.node = Node("sender")
        self._publishers = [self.node.create_publisher(String, topic, qos) for topic, qos in qualities().items()]
        self._caller = self.node.create_client(BasicTypes, SERVICE)
        self._commander = ActionClient(self.node, Fibonacci, ACTION)

    def say(self) -> None:
        """Publish the time on all topics."""
        from std_msgs.msg import String

        for publisher in self._publishers:
            publisher.publish(String(data=repr(time.time())))

    def call(self) -> list[Any]:
        """Send the time as a request and as a goal. Returns the futures of their answers."""
        from test_msgs.action import Fibonacci
        from test_msgs.srv import BasicTypes

        return [
            self._caller.call_async(BasicTypes.Request(float64_value=time.time())),
            self._commander.send_goal_async(Fibonacci.Goal(order=int(time.time() * 1000) % _DAY)),
        ]


def send() -> None:
    import rclpy

    sender = Sender()
    sender.node.create_timer(0.1, sender.say)
    sender.node.create_timer(0.5, sender.call)
    print("ready", flush=True)
    rclpy.spin(sender.node)


def once() -> None:
    import rclpy

    sender = Sender()
    answered = False
    while not answered:
        answers = sender.call()
        for answer in answers:
            rclpy.spin_until_future_complete(sender.node, answer, timeout_sec=1.0)
        answered = all(answer.done() for answer in answers)
    print("ready", flush=True)
    for _ in sys.stdin:
        sender.call()


def receive() -> None:
    import functools

    import rclpy
    from rclpy.action import ActionServer, GoalResponse
    from rclpy.node import Node
    from std_msgs.msg import String
    from test_msgs.action import Fibonacci
    from test_msgs.srv import BasicTypes

    rclpy.init()
    node = Node("robot")

    def heard(topic: str, said: String) -> None:
        print(topic, time.time() - float(said.data), flush=True)

    def answer(request: BasicTypes.Request, response: BasicTypes.Response) -> BasicTypes.Response:
        print(SERVICE, time.time() - request.float64_value, flush=True)
        return response

    def refuse(goal: Fibonacci.Goal) -> GoalResponse:
        print(ACTION, (int(time.time() * 1000) - goal.order) % _DAY / 1000, flush=True)
        return GoalResponse.REJECT

    kept = [
        *(node.create_subscription(String, t, functools.partial(heard, t), qos) for t, qos in qualities().items()),
        node.create_service(BasicTypes, SERVICE, answer),
        ActionServer(node, Fibonacci, ACTION, lambda goal: Fibonacci.Result(), goal_callback=refuse),
    ]
    print("ready", flush=True)
    rclpy.spin(node)
    del kept


if __name__ == "__main__":
    roles: dict[str, Callable[[], None]] = {"send": send, "once": once, "receive": receive}
    roles[sys.argv[1]]()
