"""What the nodes of the stack have in common: they are managed (ROS 2 design: Managed nodes), each in a process of its own.

An rclpy executor's round costs more than taking a message. So what comes in at a rate is not called back for: it is
taken out of the queue (:class:`Input`) by a loop that runs while the node is active. The executor serves what is rare.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Kept for those who come late: maps, and the last pose."""

SUCCESS = TransitionCallbackReturn.SUCCESS
FAILURE = TransitionCallbackReturn.FAILURE

Message = TypeVar("Message")


class Input(Generic[Message]):
    """A topic whose messages are taken out of its queue when they are asked for."""

    def __init__(self, node: Node, kind: type[Message], topic: str, qos: QoSProfile) -> None:
        self._node = node
        self._subscription = node.create_subscription(kind, topic, lambda message: None, qos)

    def taken(self) -> list[Message]:
        """What has come since the last time, as far as the queue holds it; the oldest first."""
        messages: list[Message] = []
        handle = self._subscription.handle
        with handle:
            while (found := handle.take_message(self._subscription.msg_type, False)) is not None:
                messages.append(found[0])
        return messages

    def close(self) -> None:
        """Ends the subscription."""
        self._node.destroy_subscription(self._subscription)


class Loop:
    """Calls a function again and again in a thread of its own until it is stopped."""

    def __init__(self, period: float, step: Callable[[], None]) -> None:
        self._period, self._step = period, step
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends it; the function does not run any more afterwards."""
        self._stopping.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        following = time.monotonic()
        while not self._stopping.is_set():
            self._step()
            # What was missed is not made up for: late commands are of no use.
            following = max(following + self._period, time.monotonic() + self._period / 4)
            self._stopping.wait(following - time.monotonic())


class Managed(LifecycleNode):
    """A managed node. Subclasses make their entities in ``configured`` and work between ``activated`` and ``deactivated``."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        # Not given to the executor, which would be woken by each of its messages.
        self._queues = rclpy.create_node(f"{name}_inputs", start_parameter_services=False, enable_rosout=False)
        self._inputs: list[Input[Any]] = []
        self._ending: list[Callable[[], object]] = []
        self.active = False
        """Whether the node is active now."""

    # -- for subclasses ---------------------------------------------------------------------------------------------

    def configured(self) -> None:
        """Make publishers, subscriptions and servers. Raises ValueError where a parameter is wrong."""

    def activated(self) -> None:
        """Begin to work."""

    def deactivated(self) -> None:
        """End the work."""

    def cleaned(self) -> None:
        """Forget what was learnt."""

    def input(self, kind: type[Message], topic: str, qos: QoSProfile) -> Input[Message]:
        """A topic to take messages from, until the node is cleaned up."""
        made = Input(self._queues, kind, topic, qos)
        self._inputs.append(made)
        return made

    def at_cleanup(self, end: Callable[[], object]) -> None:
        """Call this when the node is cleaned up."""
        self._ending.append(end)

    def parameter(self, name: str, default: Any) -> Any:
        """A parameter's value; it is declared at the first time."""
        if not self.has_parameter(name):
            self.declare_parameter(name, default)
        return self.get_parameter(name).value

    def say(self, text: str) -> None:
        """Log it."""
        self.get_logger().info(text)

    # -- transitions ------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self.configured()
        except ValueError as error:
            self.get_logger().error(str(error))
            self._clean()
            return FAILURE
        self.say("configured")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        done = super().on_activate(state)
        self.active = True
        self.activated()
        self.say("active")
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.rest()
        self.say("inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._clean()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.rest()
        self._clean()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.rest()
        self._clean()
        return super().on_error(state)

    def close(self) -> None:
        """Leave the graph."""
        self._queues.destroy_node()
        self.destroy_node()

    def rest(self) -> None:
        """End the work, if there is any."""
        if self.active:
            self.active = False
            self.deactivated()

    def _clean(self) -> None:
        while self._ending:
            self._ending.pop()()
        while self._inputs:
            self._inputs.pop().close()
        self.cleaned()


def run(make: Callable[[], Managed], *, threads: int = 2) -> None:
    """Run a node until the process is asked to end; then it is brought to rest before it leaves the graph."""
    ending = {signal.SIGTERM, signal.SIGINT}
    # Taken up by the main thread, where it waits for them. rclpy's own handler would end ROS under a node that works.
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = make()
    executor = MultiThreadedExecutor(num_threads=threads)
    executor.add_node(node)
    broken: list[BaseException] = []

    def serve() -> None:
        try:
            executor.spin()
        except BaseException as error:
            broken.append(error)
            os.kill(os.getpid(), signal.SIGTERM)

    serving = threading.Thread(target=serve, daemon=True)
    serving.start()
    if not node.active:
        node.say("waits to be configured")
    signal.sigwait(ending)
    node.rest()
    executor.shutdown(timeout_sec=1)
    serving.join(1)
    node.close()
    rclpy.try_shutdown()
    if broken:
        raise broken[0]
