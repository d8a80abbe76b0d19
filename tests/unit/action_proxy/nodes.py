"""Real ROS 2 action servers and clients for the tests, written with rclpy as users write them.

``serve ACTION``: many goals at once. ``preempt ACTION``: a new goal aborts the one before. Goal ``order``: so many
steps; from 1000 on it is rejected, from 500 on aborted at the second step.
``client ACTION ORDER...``: sends all goals and ends with the last result; lines on its input cancel: ``cancel INDEX``.
What happens is said on the standard output, one JSON object a line. STEP is the seconds of a step; with TALK a server
publishes on that topic too, 20 times a second, as a workload's output, with TALK_WORKING at each step.
With SLOW, while a file of that name is there, it leaves out three of four of them.
With DROP it loses its answers to so many requests for results, as one does that is starved of CPU.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
import time

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from test_msgs.action import Fibonacci

STEP = float(os.environ.get("STEP", "0.05"))


def say(**words: object) -> None:
    sys.stdout.write(f"{json.dumps(words)}\n")  # at once: goals have threads of their own
    sys.stdout.flush()


def name(handle) -> str:
    return bytes(handle.goal_id.uuid).hex()


class Dropping(ActionServer):
    left = int(os.environ.get("DROP", "0"))

    async def _execute_get_result_request(self, taken):
        if self.left:
            self.left -= 1
            say(event="dropped")
        else:
            await super()._execute_get_result_request(taken)


class Server:
    def __init__(self, node: Node, action: str, *, preempting: bool) -> None:
        self._preempting, self._latest = preempting, None
        topic = os.environ.get("TALK_WORKING")
        self._working = node.create_publisher(String, topic, 10) if topic else None
        self._server = Dropping(
            node,
            Fibonacci,
            action,
            execute_callback=self.execute,
            goal_callback=self.decide,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def decide(self, goal):
        return GoalResponse.REJECT if goal.order >= 1000 else GoalResponse.ACCEPT

    def execute(self, handle):
        goal, self._latest = name(handle), handle
        order = handle.request.order
        say(event="executing", goal=goal, order=order)
        sequence = [0, 1]
        for step in range(order % 500):
            if handle.is_cancel_requested:
                handle.canceled()
                say(event="canceled", goal=goal)
                return Fibonacci.Result(sequence=sequence)
            if (order >= 500 and step == 2) or (self._preempting and self._latest is not handle):
                handle.abort()
                say(event="aborted", goal=goal)
                return Fibonacci.Result(sequence=sequence)
            sequence.append(sequence[-1] + sequence[-2] if len(sequence) < 40 else 0)
            handle.publish_feedback(Fibonacci.Feedback(sequence=[step]))
            if self._working:
                self._working.publish(String(data=goal))
            time.sleep(STEP)
        handle.succeed()
        say(event="succeeded", goal=goal)
        return Fibonacci.Result(sequence=sequence)


def serve(action: str, *, preempting: bool = False) -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("application")
    Server(node, action, preempting=preempting)
    if topic := os.environ.get("TALK"):
        publisher, slow, count = node.create_publisher(String, topic, 10), os.environ.get("SLOW"), itertools.count()

        def talk() -> None:
            if next(count) % 4 == 0 or not slow or not os.path.exists(slow):
                publisher.publish(String(data="x"))

        node.create_timer(0.05, talk, callback_group=ReentrantCallbackGroup())
    executor = MultiThreadedExecutor(num_threads=6)
    executor.add_node(node)
    say(event="ready")
    executor.spin()


def client(action: str, *orders: str) -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("customer")
    found = ActionClient(node, Fibonacci, action)
    if not found.wait_for_server(timeout_sec=120):
        sys.exit("no server")
    say(event="ready")
    handles: dict[int, object] = {}
    left = set(range(len(orders)))

    def accepted(index: int, future) -> None:
        handle = handles[index] = future.result()
        say(event="answered", index=index, accepted=handle.accepted, goal=name(handle))
        if not handle.accepted:
            left.discard(index)
            return
        handle.get_result_async().add_done_callback(lambda result: ended(index, result))

    def ended(index: int, future) -> None:
        answer = future.result()
        say(event="ended", index=index, status=answer.status, result=list(answer.result.sequence))
        left.discard(index)

    def feedback(index: int, message) -> None:
        say(event="feedback", index=index, step=message.feedback.sequence[0])

    def listen() -> None:
        for line in sys.stdin:
            index = int(line.split()[1])
            asked = handles[index].cancel_goal_async()
            asked.add_done_callback(
                lambda f, i=index: say(
                    event="canceling", index=i, code=f.result().return_code, goals=len(f.result().goals_canceling)
                )
            )

    threading.Thread(target=listen, daemon=True).start()
    for index, order in enumerate(orders):
        goal = Fibonacci.Goal(order=int(order))
        sent = found.send_goal_async(goal, feedback_callback=lambda m, i=index: feedback(i, m))
        sent.add_done_callback(lambda f, i=index: accepted(i, f))
        if os.environ.get("ONE_BY_ONE"):
            while not sent.done():
                rclpy.spin_once(node, timeout_sec=0.1)
    while left:
        rclpy.spin_once(node, timeout_sec=0.1)


if __name__ == "__main__":
    role, *arguments = sys.argv[1:]
    if role == "client":
        client(*arguments)
    else:
        serve(*arguments, preempting=role == "preempt")
