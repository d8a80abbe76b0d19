"""Observes the robot's ROS graph: health, situations, and the readers of the outputs.

It reads nothing from Kubernetes.
"""
