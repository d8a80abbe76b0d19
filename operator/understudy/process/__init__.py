"""The parts that all long-running processes share: logs, HTTP pages, CPU scheduling.

This package depends neither on Kubernetes nor on ROS.
"""
