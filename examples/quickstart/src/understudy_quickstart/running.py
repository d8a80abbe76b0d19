"""What the nodes have in common."""

from __future__ import annotations

from collections.abc import Callable

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

FRESH = 0.3
"""Seconds after which what the node before said is not gone by any more, in examples/dependent."""


def run(make: Callable[[], Node]) -> None:
    """Make a node and run it until it is asked to stop, which may be while it is made."""
    rclpy.init()
    node = None
    try:
        executor = (
            SingleThreadedExecutor()
        )  # before the node, because one that is made after the signal reports an error when it is freed
        node = make()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (RuntimeError, NotInitializedException):
        if rclpy.ok():  # otherwise a signal ended ROS while the node was made, or in the middle of a callback
            raise
    finally:
        if node is not None:
            node.destroy_node()
