"""How processes of ours join the ROS graph: they serve only what they say, and tell only where they want to."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter


def own_context(*, domain_id: int | None = None) -> Context:
    """A context of this process's own; ``domain_id`` is ROS_DOMAIN_ID where it is not given.

    Unlike ``rclpy.init``, a context alone leaves the signals to the process's own loop. Without rcl's logging, which insists on a
    directory to write to, nothing of value is lost.
    """
    context = Context()
    context.init(args=[], initialize_logging=False, domain_id=domain_id)
    return context


def plain_node(name: str, context: Context) -> Node:
    """A node with nothing that others could ask it for, or hear of it, but its name."""
    return Node(
        name,
        context=context,
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )
