"""A process's place in the ROS graph: nodes, types, serialized samples, services.

Code that observes the graph is in `ros.observe`.
"""
