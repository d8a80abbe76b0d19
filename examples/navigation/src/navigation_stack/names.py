"""The nodes of the stack."""

NODES = ["map_server", "amcl", "planner_server", "controller_server", "bt_navigator"]
"""In the order in which they are brought up."""
