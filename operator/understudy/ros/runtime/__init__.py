"""A process's place in the ROS graph: nodes, types, serialized samples, services.

What is watched is in `ros.observe`.
"""
