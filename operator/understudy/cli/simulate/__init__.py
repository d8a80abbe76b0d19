"""Verbs that try a policy without a cluster: `simulate` and `learn` over a recorded bag, `watch` beside a live ROS graph."""
