"""Observes a robot's ROS graph: topics, nodes, parameters, lifecycle states.

Nothing here changes the robot.
"""
