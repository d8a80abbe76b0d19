"""The failover protocol and its strategies, on interfaces: runs without ROS and without Kubernetes in tests."""
