"""What the monitor receives in the robot's ROS graph: health, situations, and who reads the outputs.

It reads nothing from Kubernetes.
"""
