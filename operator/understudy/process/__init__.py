"""What all long-running processes share: logs, HTTP pages, CPU scheduling.

It depends neither on Kubernetes nor on ROS.
"""
