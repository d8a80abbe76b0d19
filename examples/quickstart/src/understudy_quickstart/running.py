"""What the nodes have in common."""

from __future__ import annotations

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

FRESH = 0.3
"""Seconds after which what the node before said is not gone by any more, in examples/dependent."""


def run(node: Node) -> None:
    """Run a node until it is asked to stop."""
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        if rclpy.ok():  # otherwise a signal ended ROS in the middle of a callback
            raise
    finally:
        node.destroy_node()
