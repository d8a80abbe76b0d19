"""Joins the live ROS graph that the environment selects."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

from understudy.cli.common.errors import CommandError

if TYPE_CHECKING:
    from understudy.ros.runtime.graph_node import Graph


@contextlib.contextmanager
def joined(verb: str) -> Iterator[Graph]:
    """Yield a node for a verb of the command; it subscribes to nothing. Raises CommandError."""
    try:
        from understudy.ros.runtime.lean_imports import import_rclpy

        import_rclpy()
        from understudy.ros.runtime.graph_node import Graph
    except ImportError as error:
        raise CommandError(
            f"ROS 2 is not installed ({error}): source a ROS 2 installation, or install understudy with the extra ros: "
            "pip install '.[ros]' in its repository"
        ) from error
    try:
        graph = Graph(f"understudy_{verb}_{os.getpid()}")
    except Exception as error:  # the middleware's errors are not documented
        raise CommandError(
            f"the ROS graph cannot be joined: {error}; check RMW_IMPLEMENTATION and ROS_DOMAIN_ID"
        ) from error
    try:
        yield graph
    finally:
        graph.close()
