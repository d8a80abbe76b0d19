"""Health trees: their notations, validation and exact deadlines. No Kubernetes calls, no ROS."""
