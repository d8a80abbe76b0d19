"""How the nodes of the quickstart end."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")

from rclpy.node import Node  # noqa: E402
from std_msgs.msg import Empty  # noqa: E402
from understudy_quickstart.running import run  # noqa: E402


@pytest.mark.parametrize("has_begun", [False, True])
def test_a_node_that_is_asked_to_stop_while_it_starts_ends_without_an_error(has_begun: bool) -> None:
    def make() -> Node:
        node = Node("starting") if has_begun else None
        rclpy.shutdown()
        node = node or Node("starting")
        node.create_publisher(Empty, "/late", 1)
        return node

    run(make)


def test_an_error_of_a_node_that_starts_is_not_hidden() -> None:
    def make() -> Node:
        raise RuntimeError("no map")

    try:
        with pytest.raises(RuntimeError, match="no map"):
            run(make)
    finally:
        rclpy.shutdown()
