"""What every long-running process of ours shares: logs, HTTP pages, CPU scheduling.

It knows neither Kubernetes nor ROS.
"""
