"""Options of Understudy's nodes: they offer only the services that the code creates, and publish no log messages."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter


def own_context(*, domain_id: int | None = None) -> Context:
    """Create a context of this process's own; the default of ``domain_id`` is ROS_DOMAIN_ID.

    Unlike ``rclpy.init``, a context alone leaves the signals to the process's own loop. It does not use rcl's logging,
    which requires a directory to write to; nothing of value is lost.
    """
    context = Context()
    context.init(args=[], initialize_logging=False, domain_id=domain_id)
    return context


def plain_node(name: str, context: Context) -> Node:
    """Create a node that offers no services and publishes no log messages."""
    return Node(
        name,
        context=context,
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )
