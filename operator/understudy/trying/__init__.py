"""Tries a policy without a cluster: over a recorded bag (``understudy simulate``), beside a live ROS graph (``watch``).

``understudy learn`` proposes bounds to begin with.
"""
