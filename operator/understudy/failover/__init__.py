"""The failover protocol, its strategies and its limits, on interfaces.

Pure: it runs without ROS and without Kubernetes in tests.
"""
